# SPDX-License-Identifier: Apache-2.0
"""The tutorial, command by command, as a reader types it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "tutorial.md").read_text()
FILES = re.findall(r'```python title="(\S+)"\n(.*?)```', TEXT, re.DOTALL)
CONSOLES = re.findall(r"```console\n(.*?)```", TEXT, re.DOTALL)


def commands() -> Iterator[tuple[str, str]]:
    """Yield each command of the tutorial and the output it shows."""
    for block in CONSOLES:
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, output


def normalized(text: str) -> list[str]:
    """Return the lines without what differs from machine to machine."""
    text = re.sub(r"\.0\.\d+\.video", ".0.4711.video", text)
    text = re.sub(r"-?\d+\.\d+(e-\d+)?", "#", text)
    text = re.sub(r"sha256 [0-9a-f]{64}", "sha256 #", text)
    text = re.sub(r"\d+ kB \(\d+ bytes\)", "# kB", text)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [line for line in lines if line]


def as_pattern(shown: list[str]) -> str:
    """Return the pattern of an output in which `...` stands for any lines."""
    return "".join(
        r"(?:.*\n)*" if line == "..." else re.escape(line) + "\n" for line in shown
    )


# Takes minutes: it records, draws, evaluates twice, packs and verifies.
@pytest.mark.thorough
@pytest.mark.timeout(1500)
def test_tutorial_shows_what_its_commands_print(tmp_path: Path) -> None:
    """Each command prints what stands below it, and the whole ends in an archive."""
    for name, text in FILES:
        (tmp_path / name).write_text(text)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command, output in commands():
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            timeout=600,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        printed = done.stdout.replace(str(tmp_path), "/home/ada")
        shown = as_pattern(normalized(output))
        found = "".join(f"{line}\n" for line in normalized(printed))
        assert re.fullmatch(shown, found), f"{command}\n{printed}"
    assert (tmp_path / "run.zip").is_file()


def test_every_command_shows_its_output() -> None:
    """No command stands there without what a reader then sees."""
    found = list(commands())
    assert len(found) >= 11
    for command, output in found:
        assert output.strip(), command

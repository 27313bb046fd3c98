# SPDX-License-Identifier: Apache-2.0
"""The README's blocks and the examples run."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def blocks(language: str) -> list[str]:
    return [text for kind, text in BLOCKS if kind == language]


def shell_lines() -> list[str]:
    lines = [
        line.partition("#")[0].strip() for b in blocks("sh") for line in b.split("\n")
    ]
    return sorted({line for line in lines if line})


def run(*command: str, cwd: Path) -> str:
    """Run a command that finds `mjrec` where this Python has it."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def needs_extras(text: str) -> None:
    if "dm_control" in text:
        pytest.importorskip("dm_control", reason="dm_control is not installed here")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A directory in which the README's relative paths mean something."""
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    return tmp_path


def recorded_names(directory: Path) -> set[str]:
    """Return the names of a directory's files, as a page shows them."""
    return {
        re.sub(r"\.0\.\d+\.", ".0.4711.", path.name) for path in directory.iterdir()
    }


# Takes more than five seconds: the README's own size, 480x480, drawn in software.
def test_python_block_leaves_what_is_shown(checkout: Path) -> None:
    """The program runs as it stands, and its directory holds the files below it."""
    [code], [tree] = blocks("python"), blocks("text")
    run(sys.executable, "-c", code, cwd=checkout)
    shown = set(re.findall(r"openaigym\.\S+", tree))
    assert len(shown) == 4
    assert shown <= recorded_names(checkout / "recordings" / "halfcheetah")


@pytest.mark.thorough
@pytest.mark.parametrize("line", [x for x in shell_lines() if x.startswith("mjrec")])
def test_command_runs(line: str, checkout: Path) -> None:
    """As it stands, and it says which videos it made."""
    needs_extras(line)
    out = run(sys.executable, "-m", *shlex.split(line), cwd=checkout)
    assert ".mp4" in out


def test_readme_is_short() -> None:
    """It is read in two minutes: at most 450 words, and one frame."""
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= 450
    assert text.count("![") == 1


def test_links_lead_somewhere() -> None:
    """Frames and pages of the README are there."""
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / "README.md").read_text())
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target


@pytest.mark.thorough
@pytest.mark.dm_control
def test_scripts_demo_runs(tmp_path: Path) -> None:
    """The first command: twenty episodes, six videos, two tables."""
    assert "scripts/demo" in shell_lines()
    out = run(str(ROOT / "scripts" / "demo"), str(tmp_path / "demo"), cwd=ROOT)
    assert len(list((tmp_path / "demo").glob("*/*.mp4"))) == 6
    assert out.count("truncated") == 20


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(
            path,
            marks=pytest.mark.stable_baselines3
            if path.stem == "stable_baselines3_training"
            else pytest.mark.thorough,
        )
        for path in EXAMPLES
    ],
    ids=[path.stem for path in EXAMPLES],
)
def test_example_runs(example: Path, tmp_path: Path) -> None:
    """By itself, in an empty directory, and is listed on the examples' page."""
    needs_extras(example.read_text())
    copied = shutil.copy(example, tmp_path)
    run(sys.executable, copied, cwd=tmp_path)
    assert list((tmp_path / "recordings").iterdir())
    assert example.name in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
def test_command_line_example_runs(tmp_path: Path) -> None:
    """It keeps as many videos as it says, and lists its episodes."""
    script = ROOT / "examples" / "command_line" / "evaluate.sh"
    out = run(str(script), str(tmp_path / "out"), cwd=tmp_path)
    assert len(list((tmp_path / "out").glob("*.mp4"))) == 2
    assert out.count("truncated") == 6
    assert "command_line/" in (ROOT / "examples" / "README.md").read_text()


@pytest.mark.thorough
@pytest.mark.dm_control
def test_workflow_records_and_uploads(tmp_path: Path) -> None:
    """Its own commands leave what it uploads; the rest is what setup installs too."""
    workflow = yaml.safe_load((ROOT / "examples" / "ci" / "record.yml").read_text())
    [job] = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    for command in [text for text in commands if text.startswith("mjrec")]:
        run("sh", "-ec", command, cwd=tmp_path)
    [upload] = [s for s in job["steps"] if "upload-artifact" in s.get("uses", "")]
    uploaded = tmp_path / upload["with"]["path"]
    assert len(list(uploaded.rglob("*.mp4"))) == 1
    # What it installs is what the project has.
    setup = (ROOT / "scripts" / "setup").read_text()
    [packages] = [text.split() for text in commands if "apt-get" in text]
    assert all(name in setup for name in packages if name.startswith("lib"))
    [extras] = [text for text in commands if text.startswith("pip")]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra in re.findall(r"mjrec\[([^]]+)\]", extras)[0].split(","):
        assert extra in project["optional-dependencies"]

# SPDX-License-Identifier: Apache-2.0
"""What the command line says before it does anything."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from trajectories_by_hand import write_log

from evaluations import write_evaluation
from mjrec.commands import COMMANDS, main
from mjrec.commands.overview import EXAMPLES, GROUPS
from report_recordings import entry, write_journal


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str]:
    """Return the exit status and what was printed."""
    with pytest.raises(SystemExit) as left:
        main(arguments)
    out, err = capsys.readouterr()
    return left.value.code or 0, out + err


def test_help_fits_a_small_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """All commands, in groups, in 24 lines of 80 columns."""
    status, text = said(capsys, "--help")
    assert status == 0
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert all(group in lines for group in GROUPS)
    assert [line.split()[0] for line in lines if line.startswith("  ")] == [
        name for names in GROUPS.values() for name in names
    ]
    assert {name for names in GROUPS.values() for name in names} == set(COMMANDS)


def help_of(capsys: pytest.CaptureFixture[str], command: str) -> str:
    """Return the help of a command."""
    status, text = said(capsys, command, "--help")
    assert status == 0
    return text


FIRST = {
    "record": "--out --episodes --policy --seed --size",
    "render": "--episode --camera --size --quality --workers",
    "evaluate": "--policy --out --episodes --num-seeds --workers",
    "pack": "--out --author --license --title --anonymous",
    "verify": "--level --report --sample --allow --verbose",
}


@pytest.mark.parametrize("command", FIRST)
def test_what_people_use_comes_first(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The five options that are used most lead the list."""
    text = help_of(capsys, command)
    # Lines of prose may begin with an option, too: the list is what follows -h.
    listed = text[text.index("-h, --help") :]
    options = re.findall(r"^\W*?(?:-\w(?: [A-Z]+)?, )?(--[\w-]+)", listed, re.MULTILINE)
    assert options[1:6] == FIRST[command].split()


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_nothing_of_python(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An option that need not be given is shown as `--seed INT`."""
    text = help_of(capsys, command)
    assert not re.search(r"\bNone\b|\(default: (False)?\)", text)


@pytest.mark.parametrize("command", EXAMPLES)
def test_a_command_without_arguments_shows_examples(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In place of a list of what is missing; it is an error all the same."""
    status, text = said(capsys, command)
    assert status == 2
    shown = [line.strip() for line in text.splitlines() if line.startswith("  ")]
    assert shown == list(EXAMPLES[command])
    assert all(line.startswith(f"mjrec {command} ") for line in shown)
    assert f"mjrec {command} --help" in text


def test_alone_it_says_what_is_recorded_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the directory itself and of those in it; else it shows the commands."""
    monkeypatch.chdir(tmp_path)
    status, text = said(capsys)
    assert status == 2
    assert "record  " in text
    first, second = tmp_path / "runs" / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir(parents=True)
    write_journal(first, "0.7", "X-v0", [entry(0), entry(1, recording="deferred")])
    write_log(first, 1, steps=2)
    write_evaluation(second, {"a/x": [[1.0, None]], "b/y": [[2.0, 3.0]]})
    status, text = said(capsys)
    assert status == 0
    lines = text.splitlines()
    assert lines[0].startswith("runs/first: 2 episodes, return ")
    assert lines[0].endswith("0 videos and 1 pending")
    assert lines[1] == "second: evaluation of 2 tasks, 4 episodes, 1 failed"
    assert "mjrec render runs/first" in text
    monkeypatch.chdir(first)
    assert said(capsys)[1].startswith(".: 2 episodes")


def test_unreadable_recordings_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One directory that cannot be read hides no other."""
    (tmp_path / "evaluation.json").write_text("{")
    monkeypatch.chdir(tmp_path)
    status, text = said(capsys)
    assert status == 0
    assert text.startswith(".: cannot be read: ")


# Takes more than five seconds: a completion knows the options of all commands.
def test_completion_completes(capsys: pytest.CaptureFixture[str]) -> None:
    """bash, with the script loaded, offers commands and a command's options."""
    status, script = said(capsys, "completion", "bash")
    assert status == 0

    def offered(*words: str) -> list[str]:
        given = " ".join(f"'{word}'" for word in words)
        code = (
            f"{script}\nCOMP_WORDS=({given}); COMP_CWORD={len(words) - 1}\n"
            "_tyro_mjrec; printf '%s\\n' \"${COMPREPLY[@]}\""
        )
        done = subprocess.run(
            ["bash", "-c", code], capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    assert offered("mjrec", "rec") == ["record", "recover"]
    assert "--episodes" in offered("mjrec", "record", "--ep")

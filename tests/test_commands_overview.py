# SPDX-License-Identifier: Apache-2.0
"""What the command line says before it does anything."""

import re
import subprocess

import pytest
from trajectories_by_hand import write_log

from evaluations import write_evaluation
from mjrec.commands import COMMANDS, main
from mjrec.commands.overview import EXAMPLES, GROUPS
from report_recordings import entry, write_journal


@pytest.fixture
def said(capsys):
    """Return what runs the command, and gives its exit status and what it printed."""

    def run(*arguments):
        with pytest.raises(SystemExit) as left:
            main(arguments)
        return left.value.code or 0, "".join(capsys.readouterr())

    return run


def test_help_fits_a_small_terminal(said):
    """All commands, in groups, in 24 lines of 80 columns."""
    status, text = said("--help")
    assert status == 0
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert all(group in lines for group in GROUPS)
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert listed == [name for names in GROUPS.values() for name in names]
    assert {*listed} == {*COMMANDS}


# The five options that are used most.
FIRST = {
    "record": "--out --episodes --policy --seed --size",
    "render": "--episode --camera --size --quality --workers",
    "evaluate": "--policy --out --episodes --num-seeds --workers",
    "pack": "--out --author --license --title --anonymous",
    "verify": "--level --report --sample --allow --verbose",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_what_people_use_first(command, said):
    """And nothing of Python: an option that need not be given is `--seed INT`."""
    status, text = said(command, "--help")
    assert status == 0
    assert f"usage: mjrec {command}" in text
    assert not re.search(r"\bNone\b|\(default: (False)?\)", text)
    if command in FIRST:
        # Lines of prose may begin with an option, too: the list is what follows -h.
        listed = text[text.index("-h, --help") :]
        option = r"^\W*?(?:-\w(?: [A-Z]+)?, )?(--[\w-]+)"
        options = re.findall(option, listed, re.MULTILINE)
        assert options[1:6] == FIRST[command].split()
    if command == "record":
        # Descriptions break only at the margin.
        words = " ".join(text.replace("│", " ").split())
        assert "Default: the environment's limit, or 1000" in words


@pytest.mark.parametrize("command", EXAMPLES)
def test_a_command_without_arguments_shows_examples(command, said):
    """In place of a list of what is missing; it is an error all the same."""
    status, text = said(command)
    assert status == 2
    shown = [line.strip() for line in text.splitlines() if line.startswith("  ")]
    assert shown == list(EXAMPLES[command])
    assert all(line.startswith(f"mjrec {command} ") for line in shown)
    assert f"mjrec {command} --help" in text


def test_alone_it_says_what_is_recorded_here(said, tmp_path, monkeypatch):
    """Of the directory itself and of those in it; else it shows the commands."""
    monkeypatch.chdir(tmp_path)
    status, text = said()
    assert status == 2
    assert "record  " in text
    first, second = tmp_path / "runs" / "first", tmp_path / "second"
    write_journal(first, "0.7", "X-v0", [entry(0), entry(1, recording="deferred")])
    write_log(first, 1, steps=2)
    write_evaluation(second, {"a/x": [[1.0, None]], "b/y": [[2.0, 3.0]]})
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "evaluation.json").write_text("{")
    status, text = said()
    assert status == 0
    lines = text.splitlines()
    assert lines[0].startswith("runs/first: 2 episodes, return ")
    assert lines[0].endswith("0 videos and 1 pending")
    assert lines[1] == "second: evaluation of 2 tasks, 4 episodes, 1 failed"
    assert lines[2].startswith("torn: cannot be read: ")
    assert "mjrec render runs/first" in text
    monkeypatch.chdir(first)
    assert said()[1].startswith(".: 2 episodes")


# Takes more than five seconds: a completion knows the options of all commands.
def test_completion_completes(said):
    """bash, with the script loaded, offers commands and a command's options."""
    status, script = said("completion", "bash")
    assert status == 0

    def offered(*words):
        given = " ".join(f"'{word}'" for word in words)
        code = (
            f"{script}\nCOMP_WORDS=({given}); COMP_CWORD={len(words) - 1}\n"
            "_tyro_mjrec; printf '%s\\n' \"${COMPREPLY[@]}\""
        )
        return subprocess.check_output(["bash", "-c", code], text=True).split()

    assert offered("mjrec", "rec") == ["record", "recover"]
    assert "--episodes" in offered("mjrec", "record", "--ep")

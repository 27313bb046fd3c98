# SPDX-License-Identifier: Apache-2.0
"""Test the help, examples and completion of the command line."""

import re
import subprocess

import pytest
from trajectories_by_hand import write_log

from evaluations import write_evaluation
from mjrec.commands import COMMANDS, main
from mjrec.commands.overview import EXAMPLES, GROUPS
from report_recordings import entry, write_journal


@pytest.fixture
def text_of(capsys):
    """Return a function that runs `mjrec` and returns all of its output."""

    def run(*arguments, status=0):
        with pytest.raises(SystemExit) as left:
            main(arguments)
        assert (left.value.code or 0) == status
        return "".join(capsys.readouterr())

    return run


def test_help_lists_all_commands_in_24_lines_of_80_columns(text_of):
    lines = text_of("--help").splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert all(group in lines for group in GROUPS)
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert listed == [name for names in GROUPS.values() for name in names]
    assert {*listed} == {*COMMANDS}


# These are the five most-used options of each command.
FIRST = {
    "record": "--out --episodes --policy --seed --size",
    "render": "--episode --camera --size --quality --workers",
    "evaluate": "--policy --out --episodes --num-seeds --workers",
    "pack": "--out --author --license --title --anonymous",
    "verify": "--level --report --sample --allow --verbose",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_the_most_used_options_first(command, text_of):
    """Optional values are shown as `--seed INT`, without Python's `None`."""
    text = text_of(command, "--help")
    assert f"usage: mjrec {command}" in text
    assert not re.search(r"\bNone\b|\(default: (False)?\)", text)
    if command in FIRST:
        # Skip the text before -h, where a line may also start with an option.
        listed = text[text.index("-h, --help") :]
        option = r"^\W*?(?:-\w(?: [A-Z]+)?, )?(--[\w-]+)"
        options = re.findall(option, listed, re.MULTILINE)
        assert options[1:6] == FIRST[command].split()
    if command == "record":
        # Descriptions are wrapped only at the margin.
        words = " ".join(text.replace("│", " ").split())
        assert "Default: the environment's limit, or 1000" in words


@pytest.mark.parametrize("command", EXAMPLES)
def test_command_without_arguments_shows_examples_with_status_2(command, text_of):
    text = text_of(command, status=2)
    shown = [line.strip() for line in text.splitlines() if line.startswith("  ")]
    assert shown == list(EXAMPLES[command])
    assert all(line.startswith(f"mjrec {command} ") for line in shown)
    assert f"mjrec {command} --help" in text


def test_mjrec_alone_lists_recordings_here_and_below(text_of, tmp_path, monkeypatch):
    """If there are no recordings, `mjrec` shows its commands."""
    monkeypatch.chdir(tmp_path)
    assert "record  " in text_of(status=2)
    first, second = tmp_path / "runs" / "first", tmp_path / "second"
    write_journal(first, "0.7", "X-v0", [entry(0), entry(1, recording="deferred")])
    write_log(first, 1, steps=2)
    write_evaluation(second, {"a/x": [[1.0, None]], "b/y": [[2.0, 3.0]]})
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "evaluation.json").write_text("{")
    lines = text_of().splitlines()
    assert lines[0].startswith("runs/first: 2 episodes, return ")
    assert lines[0].endswith("0 videos and 1 pending")
    assert lines[1] == "second: evaluation of 2 tasks, 4 episodes, 1 failed"
    assert lines[2].startswith("torn: cannot be read: ")
    assert any("mjrec render runs/first" in line for line in lines)
    monkeypatch.chdir(first)
    assert text_of().startswith(".: 2 episodes")


def test_unknown_option_is_status_2(text_of):
    text_of("record", "HalfCheetah-v5", "--no-such-option", status=2)


# Takes more than five seconds: it collects the options of all commands.
def test_bash_completes_commands_and_options(text_of):
    script = text_of("completion", "bash")

    def offered(*words):
        given = " ".join(f"'{word}'" for word in words)
        code = (
            f"{script}\nCOMP_WORDS=({given}); COMP_CWORD={len(words) - 1}\n"
            "_tyro_mjrec; printf '%s\\n' \"${COMPREPLY[@]}\""
        )
        return subprocess.check_output(["bash", "-c", code], text=True).split()

    assert offered("mjrec", "rec") == ["record", "recover"]
    assert "--episodes" in offered("mjrec", "record", "--ep")

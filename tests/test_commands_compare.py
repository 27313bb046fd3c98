# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import pytest

from evaluations import write_evaluation
from mjrec.commands.compare import compare
from mjrec.errors import InvalidArgument

WALK = "dm_control/walker-walk"


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    """Return two evaluations; of the first task the second is better."""
    a = write_evaluation(
        tmp_path / "a",
        {
            WALK: [[100.0, 200, 300, 400]],
            "Hopper-v5": [[5.0, 6, 7, 8]],
            "x": [[1.0] * 4],
        },
        policy="mine:old",
    )
    b = write_evaluation(
        tmp_path / "b",
        {WALK: [[500.0, 600, 700, None]], "Hopper-v5": [[5.0, 6, 7, 8]]},
        policy="mine:new",
    )
    return a, b


def test_a_table_and_a_sentence(
    two: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """What must be known first stands first, and what it comes to stands last."""
    assert compare(*two) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"Caution: {WALK}: 1 of 4 episodes of B failed")
    assert lines[1].endswith("a (policy mine:old)")
    (row,) = (line for line in map(str.strip, lines) if line.startswith(WALK))
    assert row.split()[1:5] == ["4,", "3", "250", "600"]
    assert "350 (" in row
    assert "1.00 (1.00 to 1.00)" in row
    assert "Only in A: x" in lines
    assert lines[-1].startswith(
        "B has the higher mean return on 1 of 2 tasks, and the same on 1; "
        "probability of improvement of B over A: 0.75 ("
    )
    assert "(1 of the tasks has a scale)" in lines[-1]


def test_the_same_figures_as_json(
    two: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """One object, with nothing around it."""
    assert compare(*two, as_json=True, resamples=200, seed=3, confidence=0.9) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["a"] == str(two[0])
    assert told["bootstrap"]["resamples"] == 200
    assert told["bootstrap"]["confidence"] == 0.9
    walk, hopper = told["tasks"]
    assert (walk["task"], walk["difference"], walk["probability"]) == (WALK, 350, 1)
    assert (
        walk["difference_interval"]["low"] < 350 < walk["difference_interval"]["high"]
    )
    assert hopper["p_value"] == 1
    assert told["scores"]["tasks"] == [WALK]


def test_evaluations_that_cannot_be_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The reason is in the row, and in the sentence."""
    a = write_evaluation(tmp_path / "a", {WALK: [[None, None]]})
    assert compare(a, a) == 0
    out = capsys.readouterr().out
    assert f"{WALK}: no episode of A was completed" in out
    assert out.endswith("No task could be compared.\n")


def test_text_of_files_is_no_order_to_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither escape sequences nor rich's markup."""
    a = write_evaluation(
        tmp_path / "a", {"[red]\x1b[2Jx": [[1.0, 2.0]]}, policy="[bold]\x1b[2J"
    )
    assert compare(a, a) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "[red]\\x1b[2Jx" in out
    assert "[bold]\\x1b[2J" in out


def test_impossible_confidence(two: tuple[Path, Path]) -> None:
    """It is said before anything is read."""
    with pytest.raises(InvalidArgument, match="confidence"):
        compare(*two, confidence=95)

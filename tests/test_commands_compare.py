# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from evaluations import write_evaluation
from mjrec.commands import main

WALK = "dm_control/walker-walk"


@pytest.fixture
def two(tmp_path: Path) -> list[str]:
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
        {WALK: [[500.0, 600, 700, 800]], "Hopper-v5": [[5.0, 6, 7, 8]]},
        policy="mine:new",
    )
    return [str(a), str(b)]


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return what `--json` prints."""
    main(["compare", *arguments, "--json", "--resamples", "200"])
    fields: dict[str, Any] = json.loads(capsys.readouterr().out)
    return fields


def test_a_table_and_a_sentence(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What must be known first stands first, and what it comes to stands last."""
    failed = write_evaluation(tmp_path / "c", {WALK: [[500.0, 600, None, 700]]})
    assert main(["compare", two[0], str(failed)]) == 0
    assert capsys.readouterr().out.startswith(
        f"Caution: {WALK}: 1 of 4 episodes of B failed"
    )
    assert main(["compare", *two]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("a (policy mine:old)")
    (row,) = (line for line in map(str.strip, lines) if line.startswith(WALK))
    assert row.split()[1:5] == ["4,", "4", "250", "650"]
    assert "400 (" in row
    assert "1.00 (1.00 to 1.00)" in row
    assert "Only in A: x" in lines
    assert lines[-1].startswith(
        "B has the higher mean return on 1 of 2 tasks, and the same on 1; "
        "probability of improvement of B over A: 0.75 ("
    )
    assert "(1 of the tasks has a scale)" in lines[-1]


def test_the_same_figures_as_json(
    two: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """One object, with nothing around it."""
    fields = told([*two, "--seed", "3", "--confidence", "0.9"], capsys)
    assert (fields["a"], fields["b"]) == ([two[0]], [two[1]])
    assert fields["bootstrap"] == {"resamples": 200, "seed": 3, "confidence": 0.9}
    walk, hopper = fields["tasks"]
    assert (walk["task"], walk["difference"], walk["probability"]) == (WALK, 400, 1)
    assert walk["difference_interval"]["low"] < walk["difference_interval"]["high"]
    assert hopper["p_value"] == 1
    assert fields["scores"]["tasks"] == [WALK]


def test_sets_of_evaluations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a shell writes out `runs/a* --against runs/b*`."""
    paths = [
        str(write_evaluation(tmp_path / f"{side}{k}", {WALK: [[k + add, k + add]]}))
        for side, add in (("a", 0.0), ("b", 2.5))
        for k in range(3)
    ]
    fields = told([*paths[:3], "--against", *paths[3:]], capsys)
    assert (fields["a"], fields["b"]) == (paths[:3], paths[3:])
    assert fields["unit"] == "evaluations"
    assert (fields["tasks"][0]["mean_a"], fields["tasks"][0]["mean_b"]) == (1, 3.5)
    assert main(["compare", *paths[:3], "--against", *paths[3:]]) == 0
    assert "A: 3 evaluations: " in capsys.readouterr().out


@pytest.mark.parametrize(
    "required",
    [
        "probability of improvement > 0.7",
        "probability of improvement>=0.75",
        "probability of improvement low > 0.5",
        f"{WALK}: difference low > 100",
        "difference > -1e-3",
        "paired difference >= 0",
        "IQM difference < 0.5",
        "IQM B > .6",
        "p-value <= 1",
        f"{WALK}: mean A < 251",
    ],
)
def test_what_is_required_and_there(required: str, two: list[str]) -> None:
    """A figure of all tasks together, of each, or of one; or an end of an interval."""
    assert main(["compare", *two, "--require", required]) == 0


@pytest.mark.parametrize(
    ("required", "reason"),
    [
        ("probability of improvement > 0.75", "the probability of improvement is 0.75"),
        ("difference > 0", "the difference of Hopper-v5 is 0"),
        ("Hopper-v5: p-value < 0.05", "the p-value of Hopper-v5 is 1"),
        ("probability of improvement low > 0.75", "improvement low is 0."),
    ],
)
def test_what_is_required_and_not_there(
    required: str, reason: str, two: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """The exit status is 1, and the reason stands last; that of JSON, too."""
    assert main(["compare", *two, "--require", required]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith(f"Not met: {required}: ")
    assert reason in last
    both = ["--require", required, "--require", "IQM A > 0"]
    (unmet,) = told([*two, *both], capsys)["unmet"]
    assert reason in unmet


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--require", "it is better"], "FIGURE > NUMBER"),
        (["--require", "difference > 1.2.3"], "FIGURE > NUMBER"),
        (["--require", "improvement > 0.5"], "probability of improvement"),
        (["--require", f"{WALK}: IQM A > 0.5"], "mean A"),
        (["--require", "IQM A low > 0.5"], "no interval"),
        (["--require", "y: difference > 0"], "Hopper-v5"),
        (["--margin", "0.05"], "belong together"),
        (["--no-worse-than", "A"], "belong together"),
        (["--no-worse-than", "A", "--margin", "-1"], "0 or more"),
        (["--confidence", "95"], "between 0 and 1"),
    ],
)
def test_what_cannot_be_required(
    options: list[str],
    reason: str,
    two: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The error says what can."""
    assert main(["compare", *two, *options]) == 1
    err = capsys.readouterr().err
    assert reason in err
    assert "Traceback" not in err


def test_no_worse_than(two: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """The interval decides: what is unknown, or too wide, is no evidence."""
    a, b = two
    demand = ["--no-worse-than", "A", "--margin"]
    assert main(["compare", a, b, *demand, "0.05"]) == 0
    assert main(["compare", a, a, *demand, "0.05"]) == 1
    assert main(["compare", a, a, *demand, "0.3"]) == 0
    assert main(["compare", b, a, *demand, "0.3"]) == 1
    assert main(["compare", b, a, "--no-worse-than", "B", "--margin", "0.3"]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("returns", [[None, 900.0], [math.nan, 900.0]])
def test_failed_episodes_and_nan_meet_no_requirement(
    returns: list[float | None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """However good the others are."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1.0, 2.0]]})
    b = write_evaluation(tmp_path / "b", {WALK: [returns]})
    required = ["--require", "probability of improvement > 0.5"]
    assert main(["compare", str(a), str(b), *required]) == 1
    # A caution is enough where nothing is required; figures that are not there, not.
    assert main(["compare", str(a), str(b)]) == (0 if returns[0] is None else 1)
    assert "1 of 2" in capsys.readouterr().out


def test_evaluations_that_cannot_be_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The reason is in the row, and in the sentence."""
    a = str(write_evaluation(tmp_path / "a", {WALK: [[None, None]]}))
    assert main(["compare", a, a]) == 1
    out = capsys.readouterr().out
    assert f"{WALK}: no episode of A was completed" in out
    assert out.endswith("No task could be compared.\n")
    assert main(["compare", a]) == 1
    assert "--against" in capsys.readouterr().err


def test_text_of_files_is_no_order_to_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither escape sequences nor rich's markup."""
    task = "[red]\x1b[2Jx"
    a = write_evaluation(tmp_path / "a", {task: [[1.0, 2.0]]}, policy="[bold]\x1b[2J")
    assert main(["compare", str(a), str(a)]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "[red]\\x1b[2Jx" in out
    assert "[bold]\\x1b[2J" in out

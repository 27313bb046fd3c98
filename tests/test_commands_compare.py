# SPDX-License-Identifier: Apache-2.0
import json
import math

import pytest

from evaluations import write_evaluation
from mjrec.commands import main

WALK = "dm_control/walker-walk"
SAME = {"Hopper-v5": [[5.0, 6, 7, 8]]}
WORSE = {WALK: [[100.0, 200, 300, 400]], **SAME, "x": [[1.0] * 4]}
BETTER = {WALK: [[500.0, 600, 700, 800]], **SAME}


@pytest.fixture
def write(tmp_path):
    """Return what writes an evaluation, and returns its path as a text."""
    return lambda name, *arguments, **options: str(
        write_evaluation(tmp_path / name, *arguments, **options)
    )


@pytest.fixture
def two(write):
    """Return two evaluations; of the first task the second is better."""
    return [
        write("a", WORSE, policy="mine:old"),
        write("b", BETTER, policy="mine:new", policy_kwargs={"gain": 2}),
    ]


def told(arguments, capsys):
    """Return what `--json` prints: one object, with nothing around it."""
    main(["compare", *arguments, "--json", "--resamples", "200"])
    return json.loads(capsys.readouterr().out)


def test_a_table_and_a_sentence(two, write, capsys):
    """What must be known first stands first, and what it comes to stands last."""
    assert main(["compare", *two]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("a (policy mine:old)")
    assert lines[1].endswith("b (policy mine:new, gain=2)")
    (row,) = (line for line in map(str.strip, lines) if line.startswith(WALK))
    assert row.split()[1:-1] == ["4,", "4", "250", "650", "400", "400", "1"]
    assert any(line.rstrip().endswith("(1 to 1)") for line in lines)
    assert "Only in A: x" in lines
    assert lines[-1].startswith(
        "B has the higher mean return on 1 of 2 tasks, and the same on 1; "
        "probability of improvement 0.75 ("
    )
    assert lines[-1].endswith(" (scores of 1 task).")
    failed = write("c", {WALK: [[500.0, 600, None, 700]]})
    assert main(["compare", two[0], failed]) == 0
    caution = f"Caution: {WALK}: 1 of 4 episodes of B failed"
    assert capsys.readouterr().out.startswith(caution)


def test_the_same_figures_as_json(two, capsys):
    """By the names that --require takes."""
    fields = told([*two, "--seed", "3", "--confidence", "0.9"], capsys)
    assert (fields["a"], fields["b"], fields["unmet"]) == ([two[0]], [two[1]], [])
    assert fields["bootstrap"] == {"resamples": 200, "seed": 3, "confidence": 0.9}
    figures = fields["tasks"][0]["figures"]
    assert figures["mean A"]["value"] == 250
    interval = figures["difference"]["interval"]
    assert interval["low"] < figures["difference"]["value"] == 400 < interval["high"]
    assert fields["figures"]["probability of improvement"]["value"] == 0.75


def test_sets_of_evaluations(write, capsys):
    """As a shell writes out `runs/a* --against runs/b*`."""
    a = [write(f"a{k}", {WALK: [[float(k)] * 2]}) for k in range(3)]
    b = [write(f"b{k}", {WALK: [[k + 2.5] * 2]}) for k in range(3)]
    fields = told([*a, "--against", *b], capsys)
    assert (fields["a"], fields["b"], fields["unit"]) == (a, b, "evaluations")
    figures = fields["tasks"][0]["figures"]
    assert (figures["mean A"]["value"], figures["mean B"]["value"]) == (1, 3.5)
    assert main(["compare", *a, "--against", *b]) == 0
    assert "A: 3 evaluations: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("required", "reason"),
    [
        ("probability of improvement low > 0.5", None),
        (f"{WALK}: difference low > 100", None),
        ("paired difference > -1e-3", None),
        ("IQM B > .6", None),
        ("p-value <= 1", None),
        ("probability of improvement > 0.75", "of all tasks is 0.75"),
        ("difference > 0", "the difference of Hopper-v5 is 0"),
        ("Hopper-v5: p-value < 0.05", "the p-value of Hopper-v5 is 1"),
        ("probability of improvement low > 0.75", "improvement low of all tasks is 0."),
        ("p-value low < 0.05", "is unknown"),
    ],
)
def test_what_is_required(required, reason, two, capsys):
    """A figure of all tasks together, of each, or of one; or an end of an interval.

    Where it is not there the exit status is 1, and the reason stands last.
    """
    status = main(["compare", *two, "--require", required])
    last = capsys.readouterr().out.splitlines()[-1]
    unmet = told([*two, "--require", required, "--require", "IQM A > 0"], capsys)
    if reason is None:
        assert (status, unmet["unmet"]) == (0, [])
        assert "Not met" not in last
    else:
        assert status == 1
        assert last.startswith(f"Not met: {required}: ")
        assert reason in last
        assert reason in unmet["unmet"][0]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--require", "it is better"], "FIGURE > NUMBER"),
        (["--require", "difference > 1.2.3"], "FIGURE > NUMBER"),
        (["--require", "improvement > 0.5"], "probability of improvement"),
        (["--require", f"{WALK}: IQM A > 0.5"], "mean A"),
        (["--require", "y: difference > 0"], "Hopper-v5"),
        (["--margin", "0.05"], "must be given together"),
        (["--no-worse-than", "A", "--margin", "-1"], "0 or more"),
        (["--confidence", "95"], "between 0 and 1"),
        (["more"], "--against"),
    ],
)
def test_what_cannot_be_required(options, reason, two, capsys):
    """One error, which says what can."""
    assert main(["compare", *two, *options]) == 1
    err = capsys.readouterr().err
    assert reason in err
    assert "Traceback" not in err


def test_no_worse_than(two):
    """The interval decides: what is too wide is no evidence."""
    a, b = two
    for first, second, better, margin, status in (
        (a, b, "A", "0.05", 0),
        (a, a, "A", "0.05", 1),
        (a, a, "A", "0.3", 0),
        (b, a, "A", "0.3", 1),
        (b, a, "B", "0.3", 0),
    ):
        demand = ["--no-worse-than", better, "--margin", margin]
        assert main(["compare", first, second, *demand]) == status


@pytest.mark.parametrize("returns", [[None, 900.0], [math.nan, 900.0], [None, None]])
def test_failed_episodes_and_nan_meet_no_requirement(returns, write, capsys):
    """However good the others are; and without figures the status is always 1."""
    a, b = write("a", {WALK: [[1.0, 2.0]]}), write("b", {WALK: [returns]})
    assert main(["compare", a, b, "--require", "difference > 0"]) == 1
    capsys.readouterr()
    has_figures, is_nan = returns == [None, 900.0], returns[0] is not None
    assert main(["compare", a, b]) == (0 if has_figures else 1)
    out = capsys.readouterr().out
    assert ("1 of 2" in out) or ("no episode of B was completed" in out)
    assert ("No task could be compared." in out) is not has_figures
    allowed = main(["compare", a, b, "--allow-nan"])
    assert allowed == (0 if has_figures or is_nan else 1)


def test_text_of_files_is_no_order_to_the_terminal(write, capsys):
    """Neither escape sequences nor rich's markup."""
    a = write("a", {"[red]\x1b[2Jx": [[1.0, 2.0]]}, policy="[bold]\x1b[2J")
    assert main(["compare", a, a]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "[red]\\x1b[2Jx" in out
    assert "[bold]\\x1b[2J" in out


def test_what_a_requirement_of_scores_lacks_is_said(tmp_path, capsys):
    """The option that gives a task its score range."""
    a, b = (str(write_evaluation(tmp_path / n, {"x": [[1.0, 2.0]]})) for n in "ab")
    assert main(["compare", a, b, "--no-worse-than", "A", "--margin", "0.1"]) == 1
    assert "mjrec evaluate --resume DIR --score-range" in capsys.readouterr().out

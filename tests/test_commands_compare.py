# SPDX-License-Identifier: Apache-2.0
import functools
import json
import math

import pytest

from evaluations import write_evaluation

WALK = "dm_control/walker-walk"
SAME = {"Hopper-v5": [[5.0, 6, 7, 8]]}
WORSE = {WALK: [[100.0, 200, 300, 400]], **SAME, "x": [[1.0] * 4]}
BETTER = {WALK: [[500.0, 600, 700, 800]], **SAME}


@pytest.fixture
def write(tmp_path):
    return lambda name, *arguments, **options: str(
        write_evaluation(tmp_path / name, *arguments, **options)
    )


@pytest.fixture
def two(write):
    """Return two evaluations; the second is better on the first task."""
    return [
        write("a", WORSE, policy="mine:old"),
        write("b", BETTER, policy="mine:new", policy_kwargs={"gain": 2}),
    ]


@pytest.fixture
def compare(command):
    return functools.partial(command, "compare")


@pytest.fixture
def compared(compare):
    """Return a function that parses the output of `compare --json`."""
    fast = ("--json", "--resamples", "200")
    return lambda *arguments, **rest: json.loads(compare(*arguments, *fast, **rest).out)


def test_table_follows_cautions_and_precedes_the_conclusion(two, write, compare):
    lines = compare(*two).out.splitlines()
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
    caution = f"Caution: {WALK}: 1 of 4 episodes of B failed"
    assert compare(two[0], failed).out.startswith(caution)


def test_json_figures_have_the_names_that_require_takes(two, compared):
    fields = compared(*two, "--seed", "3", "--confidence", "0.9")
    assert (fields["a"], fields["b"], fields["unmet"]) == ([two[0]], [two[1]], [])
    assert fields["bootstrap"] == {"resamples": 200, "seed": 3, "confidence": 0.9}
    figures = fields["tasks"][0]["figures"]
    assert figures["mean A"]["value"] == 250
    interval = figures["difference"]["interval"]
    assert interval["low"] < figures["difference"]["value"] == 400 < interval["high"]
    assert fields["figures"]["probability of improvement"]["value"] == 0.75


def test_compares_sets_of_evaluations(write, compare, compared):
    """These are the arguments to which a shell expands `runs/a* --against runs/b*`."""
    a = [write(f"a{k}", {WALK: [[float(k)] * 2]}) for k in range(3)]
    b = [write(f"b{k}", {WALK: [[k + 2.5] * 2]}) for k in range(3)]
    fields = compared(*a, "--against", *b)
    assert (fields["a"], fields["b"], fields["unit"]) == (a, b, "evaluations")
    figures = fields["tasks"][0]["figures"]
    assert (figures["mean A"]["value"], figures["mean B"]["value"]) == (1, 3.5)
    assert "A: 3 evaluations: " in compare(*a, "--against", *b).out


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
def test_unmet_requirement_fails_with_reason(required, reason, two, compare, compared):
    """Requirements can be about all tasks, each task, one task or an interval's end."""
    status = 0 if reason is None else 1
    requirement = ("--require", required)
    last = compare(*two, *requirement, status=status).out.splitlines()[-1]
    both = (*requirement, "--require", "IQM A > 0")
    unmet = compared(*two, *both, status=status)["unmet"]
    if reason is None:
        assert unmet == []
        assert "Not met" not in last
    else:
        assert last.startswith(f"Not met: {required}: ")
        assert reason in last
        assert reason in unmet[0]


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
def test_bad_input_is_one_error_with_the_valid_input(options, reason, two, compare):
    err = compare(*two, *options, status=1).err
    assert reason in err
    assert "Traceback" not in err


def test_no_worse_than_needs_an_interval_within_the_margin(two, compare):
    a, b = two
    for first, second, better, margin, status in (
        (a, b, "A", "0.05", 0),
        (a, a, "A", "0.05", 1),
        (a, a, "A", "0.3", 0),
        (b, a, "A", "0.3", 1),
        (b, a, "B", "0.3", 0),
    ):
        demand = ("--no-worse-than", better, "--margin", margin)
        compare(first, second, *demand, status=status)


@pytest.mark.parametrize("returns", [[None, 900.0], [math.nan, 900.0], [None, None]])
def test_failed_episodes_and_nan_meet_no_requirement(returns, write, compare):
    """If there are no figures to compare, the status is always 1."""
    a, b = write("a", {WALK: [[1.0, 2.0]]}), write("b", {WALK: [returns]})
    compare(a, b, "--require", "difference > 0", status=1)
    has_figures, is_nan = returns == [None, 900.0], returns[0] is not None
    out = compare(a, b, status=0 if has_figures else 1).out
    assert ("1 of 2" in out) or ("no episode of B was completed" in out)
    assert ("No task could be compared." in out) is not has_figures
    compare(a, b, "--allow-nan", status=0 if has_figures or is_nan else 1)


def test_text_of_files_has_no_effect_on_the_terminal(write, compare):
    """Neither escape sequences nor the markup of rich have an effect."""
    a = write("a", {"[red]\x1b[2Jx": [[1.0, 2.0]]}, policy="[bold]\x1b[2J")
    out = compare(a, a).out
    assert "\x1b" not in out
    assert "[red]\\x1b[2Jx" in out
    assert "[bold]\\x1b[2J" in out


def test_missing_score_range_is_reported_with_its_option(write, compare):
    a, b = (write(name, {"x": [[1.0, 2.0]]}) for name in "ab")
    out = compare(a, b, "--no-worse-than", "A", "--margin", "0.1", status=1).out
    assert "mjrec evaluate --resume DIR --score-range" in out

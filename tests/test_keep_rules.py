# SPDX-License-Identifier: Apache-2.0
"""The rules by which episodes are chosen after they ended."""

import math
from typing import NamedTuple

import pytest

from mjrec import InvalidArgument, UnknownName
from mjrec.recorder.keep_rules import RULES, keep_rule


class Ended(NamedTuple):
    """An episode that has ended; one without a reward could not be completed."""

    number: int
    reward: float | None
    terminated: bool | None = False
    success: bool | None = None


def episodes(*returns, **of):
    """Return episodes 0, 1 ... of one run."""
    return [
        Ended(number, value, **{name: values[number] for name, values in of.items()})
        for number, value in enumerate(returns)
    ]


def chosen(keep, ended):
    return [(each.number, role) for each, role in keep_rule(keep).choose(ended)]


@pytest.mark.parametrize(
    ("returns", "keep", "expected"),
    [
        # In the order of the rule, and within a part by rank.
        ([5, 1, 4, 2, 3], "best,median,worst", "0 best, 4 median, 1 worst"),
        ([5, 1, 4, 2], "worst:2,best:2", "1 worst, 3 worst, 0 best, 2 best"),
        # Of equal returns the earlier counts; one episode may be all three.
        ([2, 2, 2], "best,median,worst", "0 best, 0 median, 0 worst"),
        ([9, 5, 0, 5, 5], "median", "1 median"),
        # An episode that was played, never a mean of two: the lower.
        ([1, 2, 3, 4], "median", "1 median"),
        # What is no number is below minus infinity.
        (
            *([1, math.nan, -math.inf, math.inf], "worst:2,best"),
            "1 worst, 2 worst, 3 best",
        ),
        # What failed is neither best nor worst.
        ([None, None], "best:9,median,worst", ""),
        ([None, 3, 2], "worst", "2 worst"),
        # Over all runs of a task; failed ones count, so that others keep numbers.
        ([None] + [0.0] * 29, "cubic", "0 cubic, 1 cubic, 8 cubic, 27 cubic"),
        ([1, 2, None], "all", "0 all, 1 all, 2 all"),
        ([1, 2], "none", ""),
    ],
)
def test_episodes_are_chosen_by_return(returns, keep, expected):
    """By what each part of a rule says."""
    found = chosen(keep, episodes(*returns))
    assert ", ".join(f"{number} {role}" for number, role in found) == expected


def test_failures_are_what_was_no_success():
    """By the environment's word, else by its termination; and what broke."""
    results = episodes(1, 2, 3, None, success=[True, False, None, None])
    assert chosen("failures", results) == [(1, "failure"), (3, "failure")]
    assert chosen("failures:1", results) == [(1, "failure")]
    assert chosen("failures", episodes(1, terminated=[True])) == [(0, "failure")]


def test_what_was_never_begun_is_counted_and_never_chosen():
    """Later episodes keep their numbers, and the next failure takes its place."""
    ended = [None, *episodes(None, 1.0)]
    assert chosen("cubic", ended) == [(0, "cubic")]
    assert chosen("all", ended) == [(0, "all"), (1, "all")]
    assert chosen("failures:1", ended) == [(0, "failure")]
    assert chosen("best,median,worst", [None]) == []


def test_an_unknown_rule_lists_the_rules():
    """With each form; a monitor's are fewer, and some rules stand alone."""
    for keep in ("bset", "", "best:0", "best:x", "median:2", "best,"):
        with pytest.raises(UnknownName, match=r"best:N.*cubic, all, none"):
            keep_rule(keep)
    with pytest.raises(UnknownName, match=r"best:N.*failures:N\."):
        keep_rule("cubic", RULES)
    for keep in ("best,all", "none,none", "best,best:2", None):
        with pytest.raises(InvalidArgument):
            keep_rule(keep)
    # What is only spelling is not part of its name.
    assert keep_rule("best, worst").name == "best,worst"

# SPDX-License-Identifier: Apache-2.0
"""Rules that choose episodes after they ended."""

import math
from typing import NamedTuple

import pytest

from mjrec import InvalidArgument, UnknownName
from mjrec.recorder.keep_rules import RULES, keep_rule


class Episode(NamedTuple):
    """An ended episode; one without a reward failed."""

    number: int
    reward: float | None
    terminated: bool | None = False
    success: bool | None = None


def episodes(*returns, **facts):
    return [
        Episode(number, value, **{name: each[number] for name, each in facts.items()})
        for number, value in enumerate(returns)
    ]


def chosen(keep, ended):
    return [(each.number, role) for each, role in keep_rule(keep).choose(ended)]


@pytest.mark.parametrize(
    ("returns", "keep", "expected"),
    [
        # In the order of the rules, then by rank.
        ([5, 1, 4, 2, 3], "best,median,worst", "0 best, 4 median, 1 worst"),
        ([5, 1, 4, 2], "worst:2,best:2", "1 worst, 3 worst, 0 best, 2 best"),
        # Ties go to the earlier episode, which may have all roles.
        ([2, 2, 2], "best,median,worst", "0 best, 0 median, 0 worst"),
        ([9, 5, 0, 5, 5], "median", "1 median"),
        # The median of an even number is the lower one.
        ([1, 2, 3, 4], "median", "1 median"),
        # NaN is below minus infinity.
        (
            *([1, math.nan, -math.inf, math.inf], "worst:2,best"),
            "1 worst, 2 worst, 3 best",
        ),
        # Failed episodes are neither best nor worst.
        ([None, None], "best:9,median,worst", ""),
        ([None, 3, 2], "worst", "2 worst"),
        # Failed episodes count in a schedule.
        ([None] + [0.0] * 29, "cubic", "0 cubic, 1 cubic, 8 cubic, 27 cubic"),
        ([1, 2, None], "all", "0 all, 1 all, 2 all"),
        ([1, 2], "none", ""),
    ],
)
def test_episodes_are_chosen_by_return(returns, keep, expected):
    found = chosen(keep, episodes(*returns))
    assert ", ".join(f"{number} {role}" for number, role in found) == expected


def test_failures_follow_success_or_termination():
    """Failed episodes count as failures."""
    results = episodes(1, 2, 3, None, success=[True, False, None, None])
    assert chosen("failures", results) == [(1, "failure"), (3, "failure")]
    assert chosen("failures:1", results) == [(1, "failure")]
    assert chosen("failures", episodes(1, terminated=[True])) == [(0, "failure")]


def test_missing_episodes_count_but_are_never_chosen():
    """Later episodes keep their numbers."""
    ended = [None, *episodes(None, 1.0)]
    assert chosen("cubic", ended) == [(0, "cubic")]
    assert chosen("all", ended) == [(0, "all"), (1, "all")]
    assert chosen("failures:1", ended) == [(0, "failure")]
    assert chosen("best,median,worst", [None]) == []


def test_unknown_rule_lists_the_rules():
    """Monitors have fewer rules; some rules stand alone."""
    for keep in ("bset", "", "best:0", "best:x", "median:2", "best,"):
        with pytest.raises(UnknownName, match=r"best:N.*cubic, all, none"):
            keep_rule(keep)
    with pytest.raises(UnknownName, match=r"best:N.*failures:N\."):
        keep_rule("cubic", RULES)
    for keep in ("best,all", "none,none", "best,best:2", None):
        with pytest.raises(InvalidArgument):
            keep_rule(keep)
    assert keep_rule("best, worst").name == "best,worst"

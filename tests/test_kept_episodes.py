# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from mjrec import InvalidArgument, UnknownName
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.kept_episodes import keep_rule


def episodes(*returns, **of):
    """Return episodes 0, 1 ... of one run; None is one that failed."""
    return [
        EpisodeResult(
            task="T",
            seed=0,
            episode=number,
            total_reward=value,
            length=3,
            terminated=None if value is None else False,
            truncated=None if value is None else True,
            failure="it broke" if value is None else None,
            monitor="0.w",
            episode_id=number,
            **{name: values[number] for name, values in of.items()},
        )
        for number, value in enumerate(returns)
    ]


def chosen(keep, results):
    return [(each.episode, role) for each, role in keep_rule(keep).choose(results)]


@pytest.mark.parametrize(
    ("returns", "keep", "expected"),
    [
        # In the order of the rule, and within a part by rank.
        ([5, 1, 4, 2, 3], "best,median,worst", "0 best, 4 median, 1 worst"),
        (
            *([5, 1, 4, 2, 3], "worst:2,best:3"),
            "1 worst, 3 worst, 0 best, 2 best, 4 best",
        ),
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
    fallen = episodes(1)
    object.__setattr__(fallen[0], "terminated", True)
    assert chosen("failures", fallen) == [(0, "failure")]


@pytest.mark.parametrize("keep", ["failures", "all", "cubic"])
def test_what_was_never_begun_cannot_be_shown(keep):
    """There is no recording of it."""
    (result,) = episodes(None)
    object.__setattr__(result, "monitor", None)
    assert chosen(keep, [result]) == []


def test_a_rule_has_a_name():
    """Without what is only spelling."""
    assert keep_rule("best, worst").name == "best,worst"
    assert keep_rule("none").keeps_none


@pytest.mark.parametrize("keep", ["bset", "", "best:0", "best:x", "median:2", "best,"])
def test_an_unknown_rule_lists_the_rules(keep):
    """With each form."""
    with pytest.raises(UnknownName, match=r"best:N.*cubic, all, none"):
        keep_rule(keep)


@pytest.mark.parametrize("keep", ["best,all", "none,none", "best,best:2", None])
def test_what_does_not_go_together_is_refused(keep):
    """Each of them once, and what stands alone alone."""
    with pytest.raises(InvalidArgument):
        keep_rule(keep)

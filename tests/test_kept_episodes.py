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


def test_best_median_and_worst_are_by_return():
    """In the order of the rule, and within a part by rank."""
    results = episodes(5, 1, 4, 2, 3)
    assert chosen("best,median,worst", results) == [
        *((0, "best"), (4, "median"), (1, "worst"))
    ]
    assert chosen("worst:2,best:3", results) == [
        *((1, "worst"), (3, "worst"), (0, "best"), (2, "best"), (4, "best"))
    ]


def test_of_equal_returns_the_earlier_counts():
    """Also for the median; one episode may be all three."""
    assert chosen("best,median,worst", episodes(2, 2, 2)) == [
        *((0, "best"), (0, "median"), (0, "worst"))
    ]
    assert chosen("median", episodes(9, 5, 0, 5, 5)) == [(1, "median")]


def test_the_median_of_an_even_number_is_the_lower():
    """An episode that was played, never a mean of two."""
    assert chosen("median", episodes(1, 2, 3, 4)) == [(1, "median")]


def test_what_is_no_number_is_the_worst():
    """Below minus infinity."""
    results = episodes(1, math.nan, -math.inf, math.inf)
    assert chosen("worst:2,best", results) == [(1, "worst"), (2, "worst"), (3, "best")]


def test_what_failed_has_no_return():
    """It is neither best nor worst, and no episode is left over for the median."""
    assert chosen("best:9,median,worst", episodes(None, None)) == []
    assert chosen("worst", episodes(None, 3, 2)) == [(2, "worst")]


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


def test_cubic_counts_over_all_runs_of_a_task():
    """Failed episodes count too, so that the others keep their numbers."""
    assert [number for number, _ in chosen("cubic", episodes(*[0.0] * 30))] == [
        *(0, 1, 8, 27)
    ]


def test_all_and_none_are_what_they_say():
    """Each episode that has not failed, or none."""
    assert len(chosen("all", episodes(1, 2, None))) == 3
    assert chosen("none", episodes(1, 2)) == []
    assert keep_rule("none").keeps_none
    assert keep_rule("best, worst").name == "best,worst"


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

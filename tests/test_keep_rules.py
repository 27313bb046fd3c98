# SPDX-License-Identifier: Apache-2.0
"""Rules of `keep=` choose among all episodes, or as episodes end."""

import math

import numpy as np
import pytest
from finished_files import episode
from hypothesis import given
from hypothesis import strategies as st

from mjrec import InvalidArgument, UnknownName
from mjrec.recorder.keep_rules import RULES, Standing, keep_rule, selection_from


def episodes(*returns, **facts):
    """Return episodes in order, where one without a return has failed."""
    facts = {"terminated": [False] * len(returns), **facts}
    return [
        episode(n, reward=value, **{name: each[n] for name, each in facts.items()})
        for n, value in enumerate(returns)
    ]


def roles(keep, ended):
    return [(each.episode_id, role) for each, role in keep_rule(keep).choose(ended)]


def selection_of(keep, ended):
    selection = selection_from(keep)
    for each in ended:
        selection.add(each)
    return selection


@pytest.mark.parametrize(
    ("returns", "keep", "expected"),
    [
        # Episodes are listed in the order of the rules, then by rank.
        ([5, 1, 4, 2, 3], "best,median,worst", "0 best, 4 median, 1 worst"),
        ([5, 1, 4, 2], "worst:2,best:2", "1 worst, 3 worst, 0 best, 2 best"),
        # Ties go to the earlier episode, which may have every role.
        ([2, 2, 2], "best,median,worst", "0 best, 0 median, 0 worst"),
        ([9, 5, 0, 5, 5], "median", "1 median"),
        # The median of an even number of episodes is the lower middle one.
        ([1, 2, 3, 4], "median", "1 median"),
        # NaN ranks below minus infinity.
        (
            *([1, math.nan, -math.inf, math.inf], "worst:2,best"),
            "1 worst, 2 worst, 3 best",
        ),
        # A failed episode is neither best nor worst.
        ([None, None], "best:9,median,worst", ""),
        ([None, 3, 2], "worst", "2 worst"),
        # A failed episode counts in a schedule.
        ([None] + [0.0] * 29, "cubic", "0 cubic, 1 cubic, 8 cubic, 27 cubic"),
        ([1, 2, None], "all", "0 all, 1 all, 2 all"),
        ([1, 2], "none", ""),
    ],
)
def test_episodes_are_chosen_by_return(returns, keep, expected):
    found = roles(keep, episodes(*returns))
    assert ", ".join(f"{number} {role}" for number, role in found) == expected


# Few distinct values produce ties.
RETURNS = st.sampled_from([0.0, -0.0, 1.0, -2.5, 7.25, math.nan, math.inf, -math.inf])


@given(st.lists(RETURNS, max_size=12), st.integers(1, 5))
def test_selection_during_a_run_equals_sorting_at_its_end(rewards, count):
    """The selection holds few candidates, except for the median."""
    # Episode numbers may have gaps.
    ended = [episode(3 + 2 * k, reward=reward) for k, reward in enumerate(rewards)]
    rank = {
        e.episode_id: (False, 0.0) if math.isnan(e.reward) else (True, e.reward)
        for e in ended
    }
    # Python's sort is stable, even in reverse.
    worst = sorted(rank, key=rank.get)
    best = sorted(rank, key=rank.get, reverse=True)
    middle = [rank[number] for number in worst][(len(worst) - 1) // 2 :][:1]
    expected = {
        f"worst:{count}": worst[:count],
        f"best:{count}": best[:count],
        f"best:{count},worst": {*best[:count], *worst[:1]},
        "median": [number for number in rank if rank[number] in middle][:1],
    }
    for keep, numbers in expected.items():
        selection = selection_of(keep, ended)
        assert selection.undecided <= (len(ended) if keep == "median" else count + 1)
        selection.close()
        assert selection.undecided == 0
        assert selection.chosen == sorted(numbers)


def test_failures_follow_success_or_termination():
    """A failed episode counts as a failure, and the rule stops after N failures."""
    success, terminated = [True, False, None, None, None], [True, *[False] * 3, True]
    ended = episodes(1, 2, 3, None, 4, success=success, terminated=terminated)
    failures = [(number, "failure") for number in (1, 3, 4)]
    assert roles("failures", ended) == failures
    assert selection_of("failures", ended).chosen == [1, 3, 4]
    for most in (1, 2, 3, 4):
        assert roles(f"failures:{most}", ended) == failures[:most]
        selection = selection_of(f"failures:{most},best", ended)
        assert selection.chosen == [1, 3, 4][:most]
        assert selection_of(f"failures:{most}", ended)(99) == (most > 3)


def test_missing_episodes_count_but_are_never_chosen():
    """Missing episodes do not shift the numbers of later ones."""
    ended = [None, *episodes(None, 1.0)]
    assert roles("cubic", ended) == [(0, "cubic")]
    assert roles("all", ended) == [(0, "all"), (1, "all")]
    assert roles("failures:1", ended) == [(0, "failure")]
    assert roles("best,median,worst", [None]) == []


def test_function_gets_all_episodes_once_in_order():
    calls = []

    def longest(ended):
        calls.append([each.episode_id for each in ended])
        return np.array([4, 0])

    selection = selection_of(longest, episodes(*range(5)))
    assert selection.name.endswith("in_order.<locals>.longest")
    assert {selection.standing(k) for k in range(5)} == {Standing.CANDIDATE}
    selection.close()
    selection.close()
    assert calls == [[0, 1, 2, 3, 4]]
    assert selection.chosen == [0, 4]
    assert selection.standing(1) is Standing.DROPPED


def failing_function(ended):
    raise ZeroDivisionError("of the user")


@pytest.mark.parametrize(
    ("keep", "error"),
    [
        (failing_function, "failing_function .*ZeroDivisionError: of the user"),
        (lambda ended: [7, 0], "returned 7, .* episodes are 0, 1, 2"),
        (lambda ended: None, "TypeError"),
        (lambda ended: [0.5], "TypeError"),
        (lambda ended: [True, False, True], "True is not an episode number"),
    ],
)
def test_invalid_function_is_named_and_decides_nothing(keep, error):
    selection = selection_of(keep, episodes(1, 2, 3))
    with pytest.raises(InvalidArgument, match=error):
        selection.close()
    assert (selection.chosen, selection.undecided) == ([], 3)


def test_unknown_rule_lists_the_rules():
    """Monitors accept fewer rules, and some rules cannot be combined."""
    for keep in ("bset", "", "best:0", "best:x", "median:2", "best,"):
        with pytest.raises(UnknownName, match=r"best:N.*cubic, all, none"):
            keep_rule(keep)
    with pytest.raises(UnknownName, match=r"best:N.*failures:N\."):
        keep_rule("cubic", RULES)
    for keep in ("best,all", "none,none", "best,best:2", None):
        with pytest.raises(InvalidArgument):
            keep_rule(keep)
    assert keep_rule("best, worst").name == "best,worst"

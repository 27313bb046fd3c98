# SPDX-License-Identifier: Apache-2.0
"""Choosing episodes as they end, against choosing among all of them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjrec.errors import InvalidArgument
from mjrec.recorder.keep_rules import Standing, selection_from
from mjrec.recorder.tracking import FinishedEpisode


def episode(number, reward=0.0, *, terminated=True, success=None):
    """Return an episode that has ended."""
    of_all = {"length": 1, "type": "t", "seed": None, "options": None}
    return FinishedEpisode(
        episode_id=number,
        reward=reward,
        terminated=terminated,
        truncated=not terminated,
        success=success,
        start_time=0.0,
        end_time=1.0,
        total_steps=number + 1,
        **of_all,
    )


def told(keep, episodes):
    """Return a selection that has been told of the episodes."""
    selection = selection_from(keep)
    for each in episodes:
        selection.add(each)
    return selection


def chosen(keep, episodes):
    """Return what is chosen in the end."""
    selection = told(keep, episodes)
    selection.close()
    assert selection.undecided == 0
    return selection.chosen


# Few different ones, so that there are ties.
some_rewards = st.lists(
    st.sampled_from([0.0, -0.0, 1.0, -2.5, 7.25, math.nan, math.inf, -math.inf]),
    max_size=12,
)


@given(some_rewards, st.integers(1, 5))
def test_returns_are_ranked(rewards, count):
    """NaN is the worst; of equal ones the earlier counts; the median is the lower."""
    # Not every number is that of an episode.
    episodes = [episode(3 + 2 * k, reward) for k, reward in enumerate(rewards)]
    rank = {
        e.episode_id: (False, 0.0) if math.isnan(e.reward) else (True, e.reward)
        for e in episodes
    }
    # Python's sort is stable, and so is it in reverse.
    worst = sorted(rank, key=rank.get)
    best = sorted(rank, key=rank.get, reverse=True)
    assert chosen(f"worst:{count}", episodes) == sorted(worst[:count])
    assert chosen(f"best:{count}", episodes) == sorted(best[:count])
    middle = [rank[number] for number in worst][(len(worst) - 1) // 2 :][:1]
    first = [number for number in rank if rank[number] in middle][:1]
    assert chosen("median", episodes) == first


@given(
    st.lists(st.tuples(st.booleans(), st.sampled_from([True, False, None]))),
    st.integers(1, 4),
)
def test_failures_are_what_the_environment_calls_so(flags, most):
    """Where it says nothing of success, what was terminated; the first, if limited."""
    episodes, failed = [], []
    for k, (terminated, success) in enumerate(flags):
        episodes.append(episode(k, terminated=terminated, success=success))
        if success is False or (success is None and terminated):
            failed.append(k)
    assert chosen("failures", episodes) == failed
    assert chosen(f"failures:{most}", episodes) == failed[:most]
    # At the end of each, so that after the last nothing is recorded any more.
    selection = told(f"failures:{most}", episodes)
    assert selection.chosen == failed[:most]
    assert selection(99) == (len(failed) < most)


@given(some_rewards, st.lists(st.booleans(), min_size=12, max_size=12))
def test_several_rules_choose_what_each_of_them_does(rewards, terminated):
    """Also where an episode is of several; nothing is held longer than needed."""
    episodes = [
        episode(k, reward, terminated=terminated[k]) for k, reward in enumerate(rewards)
    ]
    rules = ("best:2", "worst", "failures:3")
    each = [chosen(rule, episodes) for rule in rules]
    assert chosen(",".join(rules), episodes) == sorted(set().union(*each))
    assert told(",".join(rules), episodes).undecided <= 3


def test_a_function_gets_the_finished_episodes():
    """All of them, in their order, once; NumPy's numbers will do."""
    calls = []

    def longest(episodes):
        calls.append([each.episode_id for each in episodes])
        return np.array([4, 0])

    selection = told(longest, [episode(k) for k in range(5)])
    assert selection.name.endswith("finished_episodes.<locals>.longest")
    assert {selection.standing(k) for k in range(5)} == {Standing.CANDIDATE}
    selection.close()
    selection.close()
    assert calls == [[0, 1, 2, 3, 4]]
    assert selection.chosen == [0, 4]
    assert selection.standing(1) is Standing.DROPPED


def no_function(episodes):
    raise ZeroDivisionError("of the user")


@pytest.mark.parametrize(
    ("keep", "what"),
    [
        (no_function, "no_function .*ZeroDivisionError: of the user"),
        (lambda episodes: [7, 0], "returned 7, .* episodes are 0, 1, 2"),
        (lambda episodes: None, "TypeError"),
        (lambda episodes: [0.5], "TypeError"),
        (lambda episodes: [True, False, True], "True is not an episode number"),
    ],
)
def test_a_function_that_cannot_choose_is_named(keep, what):
    """And nothing is decided, so that nothing needs to be deleted."""
    selection = told(keep, [episode(k) for k in range(3)])
    with pytest.raises(InvalidArgument, match=what):
        selection.close()
    assert selection.chosen == []
    assert selection.undecided == 3

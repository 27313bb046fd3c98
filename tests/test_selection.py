# SPDX-License-Identifier: Apache-2.0
"""Rules of `keep=` that choose episodes as they end."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjrec.errors import InvalidArgument
from mjrec.recorder.keep_rules import Standing, selection_from
from mjrec.recorder.tracking import FinishedEpisode


def episode(number, reward=0.0, *, terminated=True, success=None):
    ends = {"terminated": terminated, "truncated": not terminated, "success": success}
    facts = {"length": 1, "type": "t", "seed": None, "options": None, **ends}
    times = {"start_time": 0.0, "end_time": 1.0, "total_steps": number + 1}
    return FinishedEpisode(episode_id=number, reward=reward, **facts, **times)


def selection_of(keep, episodes):
    selection = selection_from(keep)
    for each in episodes:
        selection.add(each)
    return selection


def chosen(keep, episodes):
    selection = selection_of(keep, episodes)
    selection.close()
    assert selection.undecided == 0
    return selection.chosen


# Few values give ties.
some_rewards = st.lists(
    st.sampled_from([0.0, -0.0, 1.0, -2.5, 7.25, math.nan, math.inf, -math.inf]),
    max_size=12,
)


@given(some_rewards, st.integers(1, 5))
def test_returns_are_ranked(rewards, count):
    """NaN is worst; ties go to the earlier episode; the median is the lower one."""
    # Episode numbers may have gaps.
    episodes = [episode(3 + 2 * k, reward) for k, reward in enumerate(rewards)]
    rank = {
        e.episode_id: (False, 0.0) if math.isnan(e.reward) else (True, e.reward)
        for e in episodes
    }
    # Python's sort is stable, also in reverse.
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
def test_failures_follow_success_or_termination(flags, most):
    """Termination counts where the environment reports no success."""
    episodes, failed = [], []
    for k, (terminated, success) in enumerate(flags):
        episodes.append(episode(k, terminated=terminated, success=success))
        if success is False or (success is None and terminated):
            failed.append(k)
    assert chosen("failures", episodes) == failed
    assert chosen(f"failures:{most}", episodes) == failed[:most]
    # Each is chosen at its end; after the last one, recording stops.
    selection = selection_of(f"failures:{most}", episodes)
    assert selection.chosen == failed[:most]
    assert selection(99) == (len(failed) < most)


@given(some_rewards, st.lists(st.booleans(), min_size=12, max_size=12))
def test_several_rules_choose_the_union(rewards, terminated):
    """No episode is held longer than needed."""
    episodes = [
        episode(k, reward, terminated=terminated[k]) for k, reward in enumerate(rewards)
    ]
    rules = ("best:2", "worst", "failures:3")
    each = [chosen(rule, episodes) for rule in rules]
    assert chosen(",".join(rules), episodes) == sorted(set().union(*each))
    assert selection_of(",".join(rules), episodes).undecided <= 3


def test_function_gets_all_episodes_once_in_order():
    """It may return NumPy integers."""
    calls = []

    def longest(episodes):
        calls.append([each.episode_id for each in episodes])
        return np.array([4, 0])

    selection = selection_of(longest, [episode(k) for k in range(5)])
    assert selection.name.endswith("in_order.<locals>.longest")
    assert {selection.standing(k) for k in range(5)} == {Standing.CANDIDATE}
    selection.close()
    selection.close()
    assert calls == [[0, 1, 2, 3, 4]]
    assert selection.chosen == [0, 4]
    assert selection.standing(1) is Standing.DROPPED


def failing_function(episodes):
    raise ZeroDivisionError("of the user")


@pytest.mark.parametrize(
    ("keep", "what"),
    [
        (failing_function, "failing_function .*ZeroDivisionError: of the user"),
        (lambda episodes: [7, 0], "returned 7, .* episodes are 0, 1, 2"),
        (lambda episodes: None, "TypeError"),
        (lambda episodes: [0.5], "TypeError"),
        (lambda episodes: [True, False, True], "True is not an episode number"),
    ],
)
def test_invalid_function_is_named_and_decides_nothing(keep, what):
    selection = selection_of(keep, [episode(k) for k in range(3)])
    with pytest.raises(InvalidArgument, match=what):
        selection.close()
    assert selection.chosen == []
    assert selection.undecided == 3

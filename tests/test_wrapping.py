# SPDX-License-Identifier: Apache-2.0
"""What is said of the wrappers between a monitor and its environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest
from gymnasium.wrappers import ClipAction, RecordEpisodeStatistics, TransformReward

from mjrec.environments.wrapping import around_dm_env, around_gymnasium


def test_wrappers_that_change_something_are_named() -> None:
    """Outermost first; what only looks on, or limits, is not among them."""
    env: Any = gymnasium.make("InvertedPendulum-v5", max_episode_steps=7)
    assert around_gymnasium(env) == {"wrappers": [], "max_episode_steps": 7}
    env = RecordEpisodeStatistics(ClipAction(env))
    env = TransformReward(env, abs)
    assert around_gymnasium(env)["wrappers"] == [
        "gymnasium.wrappers.transform_reward.TransformReward",
        "gymnasium.wrappers.transform_action.ClipAction",
    ]


def test_the_least_limit_counts() -> None:
    """Whichever wrapper has it."""
    env: Any = gymnasium.make("InvertedPendulum-v5", max_episode_steps=7)
    for steps in (9, 5, 8):
        env = gymnasium.wrappers.TimeLimit(env, steps)
    assert around_gymnasium(env)["max_episode_steps"] == 5


@pytest.mark.dm_control
def test_dm_control_says_the_same() -> None:
    """Of the suite's own wrappers, of ours, and of somebody's."""
    suite = pytest.importorskip("dm_control.suite")
    from dm_control.suite.wrappers import action_noise

    from mjrec.environments.dm_env_episodes import StepLimit

    env = suite.load("cheetah", "run", task_kwargs={"time_limit": 0.5})
    assert around_dm_env(env) == {"wrappers": [], "max_episode_steps": 50}
    assert around_dm_env(StepLimit(env, 20)) == {
        "wrappers": [],
        "max_episode_steps": 20,
    }
    noisy = StepLimit(action_noise.Wrapper(env), 60)
    assert around_dm_env(noisy) == {
        "wrappers": ["dm_control.suite.wrappers.action_noise.Wrapper"],
        "max_episode_steps": 50,
    }


def test_what_hides_its_environment_is_named() -> None:
    """Whoever reads it then knows that more than a task was recorded."""

    class Opaque:
        __slots__ = ()

    [name] = around_dm_env(Opaque())["wrappers"]
    assert name.endswith("Opaque")

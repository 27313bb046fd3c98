# SPDX-License-Identifier: Apache-2.0
"""What is asked of an environment before its states are recorded, and what it costs."""

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, RecordEpisodeStatistics, TransformReward

import mjrec
from mjrec.environments.wrapping import around_dm_env, around_gymnasium


@pytest.mark.parametrize("part", ["wrapper", "environment"])
def test_an_environment_that_shows_another_is_drawn_live(part, tmp_path):
    """Its pictures do not follow from its own states."""
    options = {"render_mode": "rgb_array", "width": 48, "height": 32}
    env, other = (gymnasium.make("HalfCheetah-v5", **options) for _ in range(2))
    other.reset()
    changed = env if part == "wrapper" else env.unwrapped
    changed.render = (other if part == "wrapper" else other.unwrapped).render
    monitor = mjrec.Monitor(env, tmp_path, lambda _: True, workers=0)
    with monitor:
        monitor.reset(seed=0)
        monitor.step(np.zeros(6))
        assert isinstance(monitor.video_recorder, mjrec.VideoRecorder)
    other.close()


def test_wrappers_that_change_something_are_named():
    """Outermost first; what only looks on is not among them; the least limit counts."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=7)
    for steps in (9, 5, 8):
        env = gymnasium.wrappers.TimeLimit(env, steps)
    assert around_gymnasium(env) == {"wrappers": [], "max_episode_steps": 5}
    env = RecordEpisodeStatistics(ClipAction(env))
    env = TransformReward(env, abs)
    assert around_gymnasium(env)["wrappers"] == [
        "gymnasium.wrappers.transform_reward.TransformReward",
        "gymnasium.wrappers.transform_action.ClipAction",
    ]


@pytest.mark.dm_control
def test_dm_control_says_the_same():
    """Of the suite's own wrappers."""
    suite = pytest.importorskip("dm_control.suite")
    from dm_control.suite.wrappers import action_noise

    env = suite.load("cheetah", "run", task_kwargs={"time_limit": 0.5})
    assert around_dm_env(env) == {"wrappers": [], "max_episode_steps": 50}
    assert around_dm_env(action_noise.Wrapper(env)) == {
        "wrappers": ["dm_control.suite.wrappers.action_noise.Wrapper"],
        "max_episode_steps": 50,
    }


def test_what_hides_its_environment_is_named():
    """Whoever reads it then knows that more than a task was recorded."""

    class Opaque:
        __slots__ = ()

    [name] = around_dm_env(Opaque())["wrappers"]
    assert name.endswith("Opaque")

# SPDX-License-Identifier: Apache-2.0
"""`episode_info=True`, and what is known of success."""

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics

import mjrec
from mjrec.monitors.gymnasium_monitor import success_in


def last_info(env):
    """Run CartPole to its end; return the info of every step."""
    env.reset(seed=3)
    infos, done = [], False
    while not done:
        *_, terminated, truncated, info = env.step(1)
        infos.append(info)
        done = terminated or truncated
    return infos


def monitor(directory, env=None, **options):
    made = gymnasium.make("CartPole-v1") if env is None else env
    return mjrec.Monitor(made, directory, video_callable=False, **options)


def test_last_step_has_what_gymnasium_gives(tmp_path):
    """Keys, types and values are those of RecordEpisodeStatistics; its own stay."""
    theirs = RecordEpisodeStatistics(gymnasium.make("CartPole-v1"))
    expected = last_info(theirs)[-1]["episode"]
    with monitor(tmp_path, episode_info=True) as env:
        *before, last = last_info(env)
    assert not any("episode" in info for info in before)
    episode = last["episode"]
    assert list(episode) == list(expected) == ["r", "l", "t"]
    assert (episode["r"], episode["l"]) == (expected["r"], expected["l"])
    assert 0 < episode["t"] < 60
    with monitor(tmp_path / "around", theirs, episode_info=True) as env:
        episode = last_info(env)[-1]["episode"]
    assert episode["t"] == theirs.time_queue[-1]


def test_gymnasiums_own_goes_around_a_monitor(tmp_path):
    """It asserts that the key is absent, which is why it is off by default."""
    with monitor(tmp_path) as env:
        assert last_info(RecordEpisodeStatistics(env))[-1]["episode"]["l"] > 0
    options = {"episode_info": True}
    with monitor(tmp_path / "on", **options) as env, pytest.raises(AssertionError):
        last_info(RecordEpisodeStatistics(env))


@pytest.mark.dm_control
def test_time_steps_have_no_info_to_add_to(tmp_path):
    """An option that would do nothing is an error."""
    from dm_control import suite

    with pytest.raises(mjrec.InvalidArgument, match="episode_info"):
        mjrec.Monitor(suite.load("cartpole", "swingup"), tmp_path, episode_info=True)


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({}, None),
        ({"is_success": True}, True),
        ({"is_success": 0.0}, False),
        ({"success": np.array([False])}, False),
        ({"is_success": None, "success": True}, True),
        ({"success": "no"}, None),
        ({"success": np.zeros(2)}, None),
    ],
)
def test_success_is_what_the_info_says(info, expected):
    """Under either name; what is no truth value says nothing."""
    assert success_in(info) is expected

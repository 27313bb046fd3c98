# SPDX-License-Identifier: Apache-2.0
"""Test that monitors record every environment."""

import importlib.util
from fractions import Fraction

import gymnasium
import pytest
from parts import parametrize
from recordings import frames_in, metadata_of

from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.sessions import Session, record_session

GYMNASIUM = sorted(
    env_id
    for env_id, spec in gymnasium.registry.items()
    if "gymnasium.envs.mujoco" in str(spec.entry_point) and env_id.endswith("-v5")
)


def suite_tasks():
    if importlib.util.find_spec("dm_control") is None:
        return []
    from dm_control import suite

    return [f"dm_control/{domain}-{task}" for domain, task in suite.ALL_TASKS]


def check(name, directory, timestep):
    """Check that the video of an episode plays in real time and is not blank."""
    made = EnvironmentOptions(max_steps=3, height=48, width=64)
    session = Session(environment=name, directory=directory, seed=0, made=made)
    [episode] = record_session(session)
    assert episode.length <= 3
    metadata = metadata_of(directory, 0)
    assert metadata["frame_count"] == episode.length + 1
    expected = Fraction(timestep).limit_denominator(10**6)
    assert Fraction(metadata["timestep"]) == expected
    assert metadata["playback_speed"] == 1.0
    # No frame is black or of a single color.
    assert all(frame.std() > 5 for frame in frames_in(directory, 0))


@parametrize(
    "name", GYMNASIUM, default=("HalfCheetah-v5",), part=pytest.mark.environments
)
def test_gymnasium_environment_is_recorded(name, tmp_path):
    assert len(GYMNASIUM) == 11
    check(name, tmp_path, gymnasium.make(name).unwrapped.dt)


@pytest.mark.dm_control
@parametrize(
    "name",
    suite_tasks(),
    default=("dm_control/cheetah-run",),
    part=pytest.mark.environments,
)
def test_dm_control_task_is_recorded(name, tmp_path):
    from dm_control import suite

    env = suite.load(*name.removeprefix("dm_control/").split("-"))
    check(name, tmp_path, env.control_timestep())

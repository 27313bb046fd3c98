# SPDX-License-Identifier: Apache-2.0
"""Monitors of every environment there is."""

import importlib.util
import json
from fractions import Fraction

import av
import gymnasium
import pytest
from parts import parametrize

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


def record(name, directory, *, steps=3):
    """Record an episode; returns its metadata."""
    session = Session(
        environment=name,
        directory=directory,
        seed=0,
        made=EnvironmentOptions(max_steps=steps, height=48, width=64),
    )
    [episode] = record_session(session)
    assert episode.length <= steps
    [path] = directory.glob("*.meta.json")
    metadata = json.loads(path.read_text())
    assert metadata["frame_count"] == episode.length + 1
    return metadata


def check_frames(directory):
    """Frames have content: neither black nor of one colour."""
    [path] = directory.glob("*.mp4")
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            assert frame.to_ndarray(format="rgb24").std() > 5


def test_all_of_gymnasiums_are_known():
    """The list is not empty by mistake."""
    assert len(GYMNASIUM) == 11


@parametrize(
    "env_id", GYMNASIUM, default=("HalfCheetah-v5",), part=pytest.mark.environments
)
def test_gymnasium(env_id, tmp_path):
    """Recorded in real time, with something to see."""
    metadata = record(env_id, tmp_path)
    check_frames(tmp_path)
    env = gymnasium.make(env_id)
    assert Fraction(metadata["timestep"]) == Fraction(
        env.unwrapped.dt
    ).limit_denominator(10**6)
    assert metadata["playback_speed"] == 1.0
    env.close()


@pytest.mark.dm_control
@parametrize(
    "name",
    suite_tasks(),
    default=("dm_control/cheetah-run",),
    part=pytest.mark.environments,
)
def test_dm_control(name, tmp_path):
    """Recorded in real time, with something to see."""
    from dm_control import suite

    metadata = record(name, tmp_path)
    check_frames(tmp_path)
    env = suite.load(*name.removeprefix("dm_control/").split("-"))
    assert Fraction(metadata["timestep"]) == Fraction(
        env.control_timestep()
    ).limit_denominator(10**6)
    assert metadata["playback_speed"] == 1.0
    env.close()

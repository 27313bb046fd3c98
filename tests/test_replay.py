# SPDX-License-Identifier: Apache-2.0
"""Recorded states follow from each other."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from parts import parametrize

import mjrec

GYMNASIUM = ["HalfCheetah-v5", "Humanoid-v5", "Pusher-v5"]
GYMNASIUM += ["Ant-v5", "Hopper-v5", "HumanoidStandup-v5", "Swimmer-v5"]
GYMNASIUM += ["InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Reacher-v5"]
GYMNASIUM += ["Walker2d-v5"]
# What begins far from rest, and what settles inside its reset, which only the warm
# start of the solver remembers.
SUITE = ("humanoid-run", "cheetah-run", "finger-spin")
STEPS = 8


def replayed(path: Path, substeps: int) -> tuple[Any, Any]:
    """Return recorded states, and what follows from the ones before, from the first."""
    trajectory = mjrec.load_trajectory(path)
    model = trajectory.model()
    data = mujoco.MjData(model)
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    followed = np.empty((len(trajectory), mujoco.mj_stateSize(model, spec)))
    for k in range(len(trajectory)):
        trajectory.set_state(data, k)
        data.ctrl[:] = trajectory.component("ctrl")[k + 1]
        mujoco.mj_step(model, data, nstep=substeps)
        mujoco.mj_getState(model, data, followed[k], spec)
    return trajectory.states[1:], followed


@parametrize("env_id", GYMNASIUM, default=3, part=pytest.mark.environments)
def test_gymnasium_states_follow_bit_for_bit(env_id: str, tmp_path: Path) -> None:
    """State k, the controls of step k + 1, and stepping give state k + 1."""
    env = gymnasium.make(env_id)
    env.action_space.seed(0)
    with mjrec.Monitor(env, tmp_path, workers=0) as monitored:
        monitored.reset(seed=0)
        for _ in range(STEPS):
            if any(monitored.step(env.action_space.sample())[2:4]):
                break
        substeps = env.unwrapped.frame_skip
    [path] = tmp_path.glob("*.h5")
    recorded, followed = replayed(path, substeps)
    assert recorded.tobytes() == followed.tobytes()


def suite_tasks() -> list[str]:
    """Return the names of all tasks."""
    if importlib.util.find_spec("dm_control") is None:
        return []
    from dm_control import suite

    return [f"{domain}-{task}" for domain, task in suite.ALL_TASKS]


@pytest.mark.dm_control
@parametrize("name", suite_tasks(), default=SUITE, part=pytest.mark.environments)
def test_suite_states_follow_bit_for_bit(name: str, tmp_path: Path) -> None:
    """Also where a task changes its model at every reset."""
    suite = pytest.importorskip("dm_control.suite", reason="dm_control not installed")
    env = suite.load(*name.split("-", 1), task_kwargs={"random": 0})
    specification = env.action_spec()
    random = np.random.default_rng(0)
    with mjrec.Monitor(env, tmp_path, workers=0, trajectory_callable=True) as monitored:
        for _ in range(2):
            monitored.reset()
            for _ in range(STEPS):
                monitored.step(
                    random.uniform(specification.minimum, specification.maximum)
                )
        substeps = round(env.control_timestep() / env.physics.timestep())
    for path in tmp_path.glob("*.h5"):
        recorded, followed = replayed(path, substeps)
        assert recorded.tobytes() == followed.tobytes()

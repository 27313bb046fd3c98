# SPDX-License-Identifier: Apache-2.0
"""Usual steps of dm_control's environments are recorded as all others are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from parts import parametrize

suite = pytest.importorskip("dm_control.suite", reason="dm_control not installed")

import mujoco  # noqa: E402  after importorskip
from recorded_states import (  # noqa: E402  after importorskip
    assert_same,
    changes_in,
    is_fast,
    trajectories,
)
from recordings import stats_of  # noqa: E402  after importorskip

from mjrec import Monitor  # noqa: E402  after importorskip

pytestmark = pytest.mark.dm_control

Before = Callable[[int, Any], None]


def load(domain: str = "cheetah", task: str = "run", **options: Any) -> Any:
    """Return a task whose episodes have eight steps of its own."""
    task_kwargs = {"random": 0, "time_limit": 8 * _TIMESTEPS[domain]}
    return suite.load(domain, task, task_kwargs=task_kwargs, **options)


_TIMESTEPS = {"cheetah": 0.01, "cartpole": 0.01, "reacher": 0.02, "hopper": 0.02}


def monitored(env: Any, directory: Path, **options: Any) -> Any:
    size = {"height": 32, "width": 48}
    options = {"env_id": "dm_control/some-task", "workers": 0, **size, **options}
    return Monitor(env, directory, lambda _: True, **options)


def go(
    monitor: Any, count: int, *, usual: bool = True, before: Before | None = None
) -> list[Any]:
    """Take so many steps, and return what they returned."""
    spec, timesteps = monitor.action_spec(), []
    for number in range(1, count + 1):
        if not usual:
            monitor._recorder.fast = None
        if before is not None:
            before(number, monitor)
        action = np.full(spec.shape, np.cos(number)).clip(spec.minimum, spec.maximum)
        timesteps.append(monitor.step(action))
    return timesteps


def recorded(env: Any, directory: Path, *, camera: Any = None, **steps: Any) -> Any:
    """Record an episode of eight steps and return its trajectory."""
    with monitored(env, directory, camera=camera) as monitor:
        monitor.reset()
        go(monitor, 8, **steps)
    [trajectory] = trajectories(directory)
    return trajectory


@parametrize(
    ("domain", "task", "camera"),
    [
        ("cheetah", "run", None),
        ("cheetah", "run", "side"),
        ("cheetah", "run", mujoco.MjvCamera()),
        ("cartpole", "balance", None),
        ("reacher", "easy", 0),
        ("hopper", "stand", None),
    ],
)
def test_usual_steps_are_recorded_as_others_are(
    domain: str, task: str, camera: Any, tmp_path: Path
) -> None:
    """States, actions, rewards, ends and frames are the same, bit for bit."""
    env = load(domain, task)
    usual = recorded(env, tmp_path / "usual", camera=camera)
    env = load(domain, task)
    other = recorded(env, tmp_path / "other", camera=camera, usual=False)
    assert len(usual) == 8
    assert usual.truncated.tolist() == [False] * 7 + [True]
    assert_same(usual, other)


@pytest.mark.parametrize("max_fps", [None, 40])
def test_steps_are_usual_from_the_second_one_on(
    max_fps: int | None, tmp_path: Path
) -> None:
    """Until the episode is over; the step after it is a reset."""
    with monitored(load(), tmp_path, max_fps=max_fps) as monitor:
        seen = []
        for _ in range(2):
            assert monitor.step(np.zeros(6)).first()
            for _ in range(8):
                seen.append(is_fast(monitor))
                last = go(monitor, 1)[0]
            assert last.last()
            assert not is_fast(monitor)
    assert seen == 2 * [False, *7 * [True]]
    assert stats_of(tmp_path)["episode_lengths"] == [8, 8]


def test_a_changed_model_is_noticed_at_the_very_step(tmp_path: Path) -> None:
    """A colour set before step 4 is that of frame 4."""

    def paint(number: int, monitor: Any) -> None:
        if number == 4:
            assert is_fast(monitor)
            monitor.physics.model.geom_rgba[1, 3] = 0.5

    trajectory = recorded(load(), tmp_path, before=paint)
    assert [trajectory.model(k).geom_rgba[1, 3] for k in (3, 4, 8)] == [1, 0.5, 0.5]


def test_rewards_that_are_shown_are_recorded(tmp_path: Path) -> None:
    """`visualize_reward` paints the robot anew at every step."""
    env = load("cartpole", "balance", visualize_reward=True)
    trajectory = recorded(env, tmp_path)
    plain = recorded(load("cartpole", "balance"), tmp_path / "plain")
    np.testing.assert_array_equal(trajectory.states, plain.states)
    changed = changes_in(tmp_path)
    assert [step for step in changed if "mat_rgba" in changed[step]] == [*range(1, 9)]


def test_the_free_camera_follows_the_model(tmp_path: Path) -> None:
    """physics.render() places it anew for every picture, from the model's fields."""

    def turn(number: int, monitor: Any) -> None:
        if number in (4, 6):
            assert is_fast(monitor)
            monitor.physics.model.vis.global_.azimuth += 30

    recorded(load(), tmp_path, before=turn)
    changed = changes_in(tmp_path)
    assert list(changed) == [4, 6]
    assert all("camera.azimuth" in fields for fields in changed.values())


def test_other_data_is_recorded_from_its_first_step_on(tmp_path: Path) -> None:
    """Where the physics goes over to it in mid-episode."""
    states = []

    def note(monitor: Any) -> None:
        physics = monitor.physics
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(physics.model.ptr, spec))
        mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, spec)
        states.append(state)

    def swap(number: int, monitor: Any) -> None:
        note(monitor)
        if number == 4:
            assert is_fast(monitor)
            physics = monitor.physics
            physics._data = physics.copy(share_model=True).data
            physics._data.qpos[2] += 0.1

    with monitored(load(), tmp_path) as monitor:
        monitor.reset()
        go(monitor, 8, before=swap)
        note(monitor)
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.states, states)
    assert len(trajectory.snapshots["geom_xpos"]) == 9


def test_time_steps_need_no_more_than_dm_envs_ends(tmp_path: Path) -> None:
    """Of one's own kind they may have `first` and `last` and nothing else."""

    class Bare(NamedTuple):
        step_type: Any
        reward: Any
        discount: Any
        observation: Any

        def first(self) -> bool:
            return bool(self.step_type == 0)

        def last(self) -> bool:
            return bool(self.step_type == 2)

    env = load()
    for name in ("reset", "step"):
        method = getattr(env, name)
        setattr(env, name, lambda *args, method=method: Bare(*method(*args)))
    assert len(recorded(env, tmp_path)) == 8

# SPDX-License-Identifier: Apache-2.0
"""Usual steps of dm_control's environments are recorded as all others are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

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

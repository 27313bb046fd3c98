# SPDX-License-Identifier: Apache-2.0
"""Videos counted in steps that are rendered later, from recorded states."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from recordings import manifest_of

import mjrec
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.rendering.finishing import finish_pending
from mjrec.rendering.pending import look_at, recordings


class Blinking(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Shows another colour after every step and every reset."""

    def reset(self, **options: Any) -> Any:
        self._blink(0.5)
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        self._blink(0.1)
        return self.env.step(action)

    def _blink(self, more: float) -> None:
        colour: Any = self.env.unwrapped.model.geom_rgba  # type: ignore[attr-defined]  # MuJoCo's
        colour[:, 0] = (colour[:, 0] + more) % 1


def hopper(length: int = 5, **made: Any) -> gymnasium.Env[Any, Any]:
    """Return a hopper whose episodes are short, and small pictures of it."""
    size = {"width": 48, "height": 48}
    return Blinking(
        gymnasium.make("Hopper-v5", max_episode_steps=length, **size, **made)
    )


def reacher() -> Any:
    """Return a task whose resets put another target into the model."""
    from dm_control import suite

    return suite.load("reacher", "easy", {"random": 3, "time_limit": 0.08})


def hop(env: Any, steps: int) -> None:
    """Take so many steps, with resets where they are needed."""
    done = True
    for number in range(steps):
        if done:
            env.reset(seed=number)
        *_, terminated, truncated, _ = env.step(np.full(3, 0.1 * (number % 7)))
        done = terminated or truncated


def reach(env: Any, steps: int) -> None:
    """Take so many steps; a step after the last one of an episode is a reset."""
    timestep = env.reset()
    for number in range(steps):
        if timestep.last():
            env.reset()
        timestep = env.step(np.full(2, 0.1 * (number % 7)))


def record(directory: Path, env: Any, steps: int, **options: Any) -> None:
    """Record so many steps of an environment, and all videos of them."""
    ride = hop if isinstance(env, gymnasium.Env) else reach
    with mjrec.Monitor(env, directory, **options) as monitor:
        ride(monitor, steps)


def finish(directory: Path) -> list[Any]:
    """Render what is pending."""
    return list(finish_pending(directory, recordings(directory), workers=1))


def parts(directory: Path) -> list[str]:
    """Return the names of all logs of clips, without their beginnings."""
    files = sorted(directory.glob("openaigym.clip.*"))
    return [path.name.partition(".step")[2] for path in files]


def hashes(directory: Path) -> dict[str, list[str]]:
    """Return the hashes of the pictures of each video, by the end of its name."""
    return {
        path.name.partition(".video")[2].split(".video")[-1]: [
            line.split(",")[-1].strip()
            for line in path.read_text().splitlines()
            if not line.startswith("#")
        ]
        for path in sorted(directory.glob("*.framehash"))
    }


def told(directory: Path) -> Iterator[dict[str, Any]]:
    """Yield the metadata of each video."""
    for path in sorted(directory.glob("*.meta.json")):
        yield json.loads(path.read_text())


SAME = (
    *("episode_id", "first_step", "last_episode_id", "length", "reward", "complete"),
    *("fps", "timestep", "stride", "frame_count", "frame_steps", "seed", "type"),
    *("reason", "height", "width", "camera"),
)


def check_same(live: Path, deferred: Path) -> None:
    """Check that both show the same, and say the same of it."""
    assert hashes(live)
    assert hashes(live) == hashes(deferred)
    for one, other in zip(told(live), told(deferred), strict=True):
        assert (one["recording"], other["recording"]) == ("live", "deferred")
        assert {key: one.get(key) for key in SAME} == {
            key: other.get(key) for key in SAME
        }


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"camera": "track"},
        {"camera": "track", "annotate": True},
        {"max_fps": 50},
        {"annotate": True, "max_fps": 60, "camera": None},
    ],
)
def test_pictures_are_those_that_were_drawn_live(
    options: dict[str, Any], tmp_path: Path
) -> None:
    """Byte for byte, across resets and from the midst of an episode."""
    clips: dict[str, Any] = {
        "step_trigger": lambda step: step in (2, 20),
        "video_length": 13,
    }
    for render in ("live", "deferred"):
        env = hopper(render_mode="rgb_array")
        record(tmp_path / render, env, 36, render=render, **clips, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")
    assert not parts(tmp_path / "deferred")


@pytest.mark.parametrize("annotate", [False, True])
def test_resets_that_change_the_model_are_seen(annotate: bool, tmp_path: Path) -> None:
    """Of a task whose target lies elsewhere in each episode."""
    options: dict[str, Any] = {
        "step_trigger": lambda step: step == 1,
        "video_length": 9,
        "height": 48,
        "width": 64,
        "annotate": annotate,
        "env_id": "dm_control/reacher-easy",
    }
    for render in ("live", "deferred"):
        record(tmp_path / render, reacher(), 14, render=render, **options)
    check_same(tmp_path / "live", tmp_path / "deferred")

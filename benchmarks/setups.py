# SPDX-License-Identifier: Apache-2.0
"""Environments, with or without a recorder."""

from __future__ import annotations

import functools
import importlib.util
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import mjrec

BARE, MONITOR, RECORD_VIDEO = "bare", "mjrec.Monitor", "RecordVideo"

# The prefix of the names of dm_control's tasks.
SUITE = "dm_control/"

# Options that prevent episodes with random actions from ending before the time limit.
UNENDING: dict[str, dict[str, Any]] = {
    "Hopper-v5": {"terminate_when_unhealthy": False},
    "Humanoid-v5": {"terminate_when_unhealthy": False},
}

_EPISODES: dict[str, Callable[[int], bool] | bool | None] = {
    "all": lambda _: True,
    "scheduled": None,
    "none": False,
}


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A Gymnasium environment and its recorder, as values that JSON can represent.

    Attributes:
        env_id: id of the environment.
        recorder: `BARE`, `MONITOR` or `RECORD_VIDEO`.
        episodes: the episodes that get a video: "all", "scheduled" or "none".
        make: keyword arguments for `gymnasium.make`.
        options: keyword arguments for `mjrec.Monitor`.
        waits: whether the monitor's `close` waits for the videos.
    """

    env_id: str
    recorder: str = BARE
    episodes: str = "all"
    make: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    waits: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return the keyword arguments that recreate the setup in another process."""
        return asdict(self)

    def open(self, directory: str | Path) -> Any:
        """Create the environment, with a recorder that writes to `directory`."""
        if self.recorder == BARE:
            return gymnasium.make(self.env_id, **self.make)
        if self.recorder == RECORD_VIDEO:
            drawn = gymnasium.make(self.env_id, render_mode="rgb_array", **self.make)
            return gymnasium.wrappers.RecordVideo(
                drawn, str(directory), episode_trigger=lambda _: True
            )
        env = gymnasium.make(self.env_id, **self.make)
        episodes = _EPISODES[self.episodes]
        return mjrec.Monitor(env, directory, episodes, **self.options)

    def close(self, env: Any) -> float:
        """Close an environment from `open`, and return the seconds that it took."""
        start = time.perf_counter()
        if self.recorder == MONITOR:
            env.close(wait=self.waits)
        else:
            env.close()
        return time.perf_counter() - start


def has_moviepy() -> bool:
    """Return whether moviepy, which RecordVideo needs, is installed."""
    return importlib.util.find_spec("moviepy") is not None


def is_there(env_id: str) -> bool:
    """Return whether an environment's framework is installed."""
    return not env_id.startswith(SUITE) or bool(importlib.util.find_spec("dm_control"))


def suite_environment(env_id: str) -> Any:
    """Return a task from dm_control's suite, which must be installed."""
    # Imported here because dm_control may not be installed.
    from dm_control import suite

    domain, _, task = env_id.removeprefix(SUITE).partition("-")
    return suite.load(domain, task, task_kwargs={"random": 0})


def random_actions(env: Any, count: int) -> list[Any]:
    """Return random actions that are the same in every call.

    Sampling takes time, so the actions are sampled in advance. They repeat after 500.

    Args:
        env: an environment from Gymnasium or dm_control.
        count: number of actions.
    """
    draw = _drawing(env)
    some = [draw() for _ in range(min(count, 500))]
    return [some[index % len(some)] for index in range(count)]


def _drawing(env: Any) -> Callable[[], Any]:
    if hasattr(env, "action_space"):
        env.action_space.seed(0)
        sample: Callable[[], Any] = env.action_space.sample
        return sample
    spec, generator = env.action_spec(), np.random.default_rng(0)
    return functools.partial(generator.uniform, spec.minimum, spec.maximum)


def seconds_to_step(env: Any, actions: Iterable[Any]) -> float:
    """Step an environment, reset it after each episode, and return the seconds."""
    step, reset = env.step, env.reset
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = step(action)
        if terminated or truncated:
            reset()
    return time.perf_counter() - start

# SPDX-License-Identifier: Apache-2.0
"""Environments, bare or with somebody who records them."""

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

# The names of dm_control's tasks begin with it.
SUITE = "dm_control/"

# What keeps episodes of random actions going until their time is over.
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
    """A Gymnasium environment and its recorder, in what JSON can hold.

    Attributes:
        env_id: of the environment.
        recorder: `BARE`, `MONITOR` or `RECORD_VIDEO`.
        episodes: which get a video: "all", "scheduled" or "none".
        make: keyword arguments of `gymnasium.make`.
        options: keyword arguments of `mjrec.Monitor`.
        waits: whether its `close` waits for the videos.
    """

    env_id: str
    recorder: str = BARE
    episodes: str = "all"
    make: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    waits: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return what `Setup(**...)` takes in another process."""
        return asdict(self)

    def open(self, directory: str | Path) -> Any:
        """Return the environment, which is recorded into `directory`."""
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
        """Close what `open` returned, and return how long it took."""
        start = time.perf_counter()
        if self.recorder == MONITOR:
            env.close(wait=self.waits)
        else:
            env.close()
        return time.perf_counter() - start


def has_moviepy() -> bool:
    """Return whether RecordVideo can write videos here."""
    return importlib.util.find_spec("moviepy") is not None


def is_there(env_id: str) -> bool:
    """Return whether an environment's framework is installed."""
    return not env_id.startswith(SUITE) or bool(importlib.util.find_spec("dm_control"))


def suite_environment(env_id: str) -> Any:
    """Return a task of dm_control's suite, where `is_there`."""
    # Here, because it may not be installed.
    from dm_control import suite

    domain, _, task = env_id.removeprefix(SUITE).partition("-")
    return suite.load(domain, task, task_kwargs={"random": 0})


def random_actions(env: Any, count: int) -> list[Any]:
    """Return the same actions at every call, made beforehand: drawing them takes time.

    After half a thousand they come again.

    Args:
        env: an environment of Gymnasium's or of dm_control's.
        count: how many.
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
    """Step the environment, reset it where an episode ends, return how long it took."""
    step, reset = env.step, env.reset
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = step(action)
        if terminated or truncated:
            reset()
    return time.perf_counter() - start

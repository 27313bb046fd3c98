# SPDX-License-Identifier: Apache-2.0
"""Environments, bare or with somebody who records them."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium

import mjrec

__all__ = [
    "BARE",
    "MONITOR",
    "RECORD_VIDEO",
    "UNENDING",
    "Setup",
    "has_moviepy",
    "random_actions",
    "seconds_to_step",
]

BARE, MONITOR, RECORD_VIDEO = "bare", "mjrec.Monitor", "RecordVideo"

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


def random_actions(env: Any, count: int) -> list[Any]:
    """Return the same actions at every call, made beforehand: drawing them takes time.

    After half a thousand they come again.
    """
    env.action_space.seed(0)
    some = [env.action_space.sample() for _ in range(min(count, 500))]
    return [some[index % len(some)] for index in range(count)]


def seconds_to_step(env: Any, actions: Iterable[Any]) -> float:
    """Step the environment, reset it where an episode ends, return how long it took."""
    step, reset = env.step, env.reset
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = step(action)
        if terminated or truncated:
            reset()
    return time.perf_counter() - start

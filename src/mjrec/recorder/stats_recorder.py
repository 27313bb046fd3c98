# SPDX-License-Identifier: Apache-2.0
"""Statistics of episodes: lengths, returns, times, types."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ClosedError, InvalidArgument, ResetNeeded, ResetNotAllowed
from ..formats.manifest import StatsFile, write_stats_file

_TYPES = ("t", "e")


class StatsRecorder:
    """Counts steps and sums rewards of episodes, with gym's interface.

    Call `before_reset`, reset the environment, call `after_reset`; for every step call
    `before_step`, step the environment, call `after_step`. Only complete episodes are
    in the statistics.

    Args:
        directory: of the statistics file. It must exist at `flush` or `close`.
        file_prefix: the file is `<file_prefix>.stats.json`.
        autoreset: the environment starts a new episode in the step that ends the last.
        env_id: the environment's name, for messages.
        allow_early_reset: a reset in the middle of an episode drops it instead of
            raising `ResetNotAllowed`.

    Attributes:
        initial_reset_timestamp: wall-clock seconds since the epoch, just before the
            first reset. None before it.
        timestamps: wall-clock time at the end of each complete episode.
        episode_lengths: steps of each complete episode.
        episode_rewards: sum of rewards of each complete episode, in float64, in step
            order.
        episode_types: "t" (training) or "e" (evaluation) of each complete episode.
        steps: steps of the running episode. None before the first reset.
        rewards: its sum of rewards. None before the first reset.
        done: whether it is over. None before the first reset.
        total_steps: all steps, including incomplete episodes.
        closed: whether `close` was called.
        path: the statistics file.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        file_prefix: str,
        autoreset: bool = False,
        env_id: str | None = None,
        *,
        allow_early_reset: bool = False,
    ) -> None:
        # Absolute, so that a later chdir does not lose the file.
        self.directory = str(Path(directory).absolute())
        self.file_prefix = file_prefix
        self.autoreset = autoreset
        self.env_id = env_id
        self.allow_early_reset = allow_early_reset
        self.initial_reset_timestamp: float | None = None
        self.timestamps: list[float] = []
        self.episode_lengths: list[int] = []
        self.episode_rewards: list[float] = []
        self.episode_types: list[str] = []
        self.steps: int | None = None
        self.rewards: float | None = None
        self.done: bool | None = None
        self.total_steps = 0
        self.closed = False
        self.clock: Callable[[], float] = time.time
        self.path = str(Path(self.directory) / f"{file_prefix}.stats.json")
        self._type = _TYPES[0]
        self._episode_type = _TYPES[0]

    @property
    def type(self) -> str:
        """The type of the episodes from the next reset on: "t" or "e".

        Raises:
            InvalidArgument: set to something else.
        """
        return self._type

    @type.setter
    def type(self, value: str) -> None:
        if value not in _TYPES:
            raise InvalidArgument(
                f'An episode\'s type is "t" (training) or "e" (evaluation), got '
                f"{value!r}."
            )
        self._type = value

    @property
    def episode_type(self) -> str:
        """The type of the running episode."""
        return self._episode_type

    def before_step(self, action: object = None) -> None:
        """Check that a step may be taken.

        Raises:
            ResetNeeded: there was no reset yet, or the episode is over.
            ClosedError: the recorder is closed.
        """
        if self.done is False and not self.closed:
            return
        self._check_open()
        if self.done is None:
            raise ResetNeeded(
                f"step() was called on {self._environment} before the first reset(). "
                "Call reset() first."
            )
        raise ResetNeeded(
            f"step() was called on {self._environment} after the end of an episode. "
            "Call reset() when terminated or truncated is true."
        )

    def after_step(
        self, observation: object, reward: Any, done: bool, info: object = None
    ) -> bool:
        """Count a step and return `done`.

        Args:
            observation: unused.
            reward: a number, or an array of one element.
            done: whether the episode is over (terminated or truncated).
            info: unused.

        Raises:
            InvalidArgument: the reward is not one number.
        """
        self.count(reward_to_float(reward), bool(done))
        if done and self.autoreset:
            self.before_reset()
            self.after_reset(observation)
        return bool(done)

    def count(self, reward: float, done: bool) -> None:
        """Count a step like `after_step`, but never start another episode."""
        assert self.steps is not None  # before_step has seen to it
        assert self.rewards is not None
        self.rewards += reward
        self.steps += 1
        self.total_steps += 1
        self.done = done
        if done:
            self.save_complete()

    def before_reset(
        self, *, after_error: bool = False, now: float | None = None
    ) -> None:
        """Check that a reset may be made.

        Args:
            after_error: the environment has raised, so that there is no other way on.
            now: the time, where the caller has read the clock already.

        Raises:
            ResetNotAllowed: the episode has begun and is not over.
            ClosedError: the recorder is closed.
        """
        self._check_open()
        allowed = self.allow_early_reset or after_error
        if self.done is False and self.steps and not allowed:
            raise ResetNotAllowed(
                f"reset() was called on {self._environment} after {self.steps} steps "
                "of an episode that is not over. Go on until terminated or truncated "
                "is true, or allow it with allow_early_reset=True; the episode is then "
                "no part of the statistics."
            )
        if self.initial_reset_timestamp is None:
            self.initial_reset_timestamp = self.clock() if now is None else now

    def after_reset(self, observation: object = None) -> None:
        """Begin an episode."""
        self.steps = 0
        self.rewards = 0.0
        self.done = False
        self._episode_type = self._type

    def save_complete(self) -> None:
        """Append the running episode, as complete, to the statistics."""
        assert self.steps is not None
        assert self.rewards is not None
        self.episode_lengths.append(self.steps)
        self.episode_rewards.append(self.rewards)
        self.episode_types.append(self._episode_type)
        self.timestamps.append(self.clock())

    def close(self) -> None:
        """Write the statistics file and end. A second call does nothing."""
        self.flush()
        self.closed = True

    def flush(self) -> None:
        """Write the statistics file; nothing once closed."""
        if not self.closed:
            write_stats_file(Path(self.path), self.stats())

    def stats(self) -> StatsFile:
        """Return what the file holds, as of now."""
        return StatsFile(
            initial_reset_timestamp=self.initial_reset_timestamp,
            timestamps=tuple(self.timestamps),
            episode_lengths=tuple(self.episode_lengths),
            episode_rewards=tuple(self.episode_rewards),
            episode_types=tuple(self.episode_types),
        )

    @property
    def _environment(self) -> str:
        return self.env_id or "the environment"

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedError(f"The statistics {self.path} are closed.")


def reward_to_float(reward: Any) -> float:
    """Return a reward as a float.

    Args:
        reward: a number, a NumPy scalar or an array of one element.

    Raises:
        InvalidArgument: it is something else.
    """
    if isinstance(reward, float):  # as NumPy's float64 is
        return float(reward)
    array = np.asarray(reward)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise InvalidArgument(
            f"A reward must be one number, got {reward!r}. An environment with several "
            "rewards needs a wrapper that makes one number of them."
        )
    return float(array.item())

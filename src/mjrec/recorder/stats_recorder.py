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
        directory: the statistics file's directory. It must exist at `flush` or `close`.
        file_prefix: the file is `<file_prefix>.stats.json`.
        autoreset: whether the environment starts a new episode in the step that ends
            the last one.
        env_id: the environment's name, for messages.
        allow_early_reset: whether a reset in the middle of an episode drops the episode
            instead of raising `ResetNotAllowed`.

    Attributes:
        initial_reset_timestamp: wall-clock seconds since the epoch, just before the
            first reset. None before it.
        timestamps: wall-clock time at the end of each complete episode.
        episode_lengths: number of steps of each complete episode.
        episode_rewards: sum of rewards of each complete episode, added in float64 in
            step order.
        episode_types: "t" (training) or "e" (evaluation) of each complete episode.
        steps: number of steps of the running episode. None before the first reset.
        rewards: sum of rewards of the running episode. None before the first reset.
        done: whether the running episode is over. None before the first reset.
        total_steps: number of all steps, including those of incomplete episodes.
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
                f'An episode\'s type must be "t" (training) or "e" (evaluation), got '
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
            ResetNeeded: there has been no reset yet, or the episode is over.
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
        """Count a step like `after_step`, but never start a new episode."""
        assert self.steps is not None  # before_step has checked it
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
        """Check that a reset is allowed.

        Args:
            after_error: whether the environment has raised, so that a reset is the only
                way to continue.
            now: the time, if the caller has already read the clock.

        Raises:
            ResetNotAllowed: the episode has begun and is not over.
            ClosedError: the recorder is closed.
        """
        self._check_open()
        allowed = self.allow_early_reset or after_error
        if self.done is False and self.steps and not allowed:
            raise ResetNotAllowed(
                f"reset() was called on {self._environment} after {self.steps} steps "
                "of an episode that is not over. Continue until terminated or "
                "truncated is true, or allow it with allow_early_reset=True, which "
                "leaves the episode out of the statistics."
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
        """Append the running episode to the statistics as complete."""
        assert self.steps is not None
        assert self.rewards is not None
        self.episode_lengths.append(self.steps)
        self.episode_rewards.append(self.rewards)
        self.episode_types.append(self._episode_type)
        self.timestamps.append(self.clock())

    def close(self) -> None:
        """Write the statistics file and close. A second call does nothing."""
        self.flush()
        self.closed = True

    def flush(self) -> None:
        """Write the statistics file, unless the recorder is closed."""
        if not self.closed:
            write_stats_file(Path(self.path), self.stats())

    def stats(self) -> StatsFile:
        """Return the current content of the statistics file."""
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
            raise ClosedError(f"The statistics recorder of {self.path} is closed.")


def reward_to_float(reward: Any) -> float:
    """Return a reward as a float.

    Args:
        reward: a number, a NumPy scalar or an array of one element.

    Raises:
        InvalidArgument: `reward` is something else.
    """
    if isinstance(reward, float):  # includes NumPy's float64
        return float(reward)
    array = np.asarray(reward)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise InvalidArgument(
            f"A reward must be one number, got {reward!r}. An environment with several "
            "rewards needs a wrapper that combines them into one number."
        )
    return float(array.item())

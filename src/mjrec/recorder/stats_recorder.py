# SPDX-License-Identifier: Apache-2.0
"""A recorder for the statistics of episodes: lengths, returns, times and types."""

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
    """Counts the steps and adds up the rewards of episodes, with gym's interface.

    For each episode, call `before_reset`, reset the environment, and call
    `after_reset`. For each step, call `before_step`, step the environment, and call
    `after_step`. The statistics include only complete episodes.

    Args:
        directory: the directory of the statistics file. It must exist when `flush` or
            `close` is called.
        file_prefix: prefix of the file name, `<file_prefix>.stats.json`.
        autoreset: whether the step that ends an episode also starts a new episode.
        env_id: the environment's name, for messages.
        allow_early_reset: whether a reset in mid-episode drops the episode instead of
            raising `ResetNotAllowed`.

    Attributes:
        initial_reset_timestamp: time just before the first reset, in seconds since the
            Unix epoch; None before the first reset.
        timestamps: time at the end of each complete episode, in seconds since the Unix
            epoch.
        episode_lengths: number of steps in each complete episode.
        episode_rewards: sum of the rewards in each complete episode, added in float64
            in the order of the steps.
        episode_types: type of each complete episode, "t" (training) or "e"
            (evaluation).
        steps: number of steps in the running episode; None before the first reset.
        rewards: sum of the rewards in the running episode; None before the first reset.
        done: whether the running episode is over; None before the first reset.
        episode_type: the type of the running episode.
        total_steps: total number of steps, including steps of incomplete episodes.
        closed: whether the recorder is closed.
        path: path of the statistics file.
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
        self._type = self.episode_type = _TYPES[0]
        self._environment = env_id or "the environment"

    @property
    def type(self) -> str:
        """The type of episodes from the next reset on, "t" or "e".

        Raises:
            InvalidArgument: the new value is not "t" or "e".
        """
        return self._type

    @type.setter
    def type(self, value: str) -> None:
        if value not in _TYPES:
            raise InvalidArgument(
                f'An episode\'s type must be "t" (training) or "e" (evaluation), but '
                f"it is {value!r}."
            )
        self._type = value

    def before_step(self, action: object = None) -> None:
        """Check that a step is allowed.

        Raises:
            ResetNeeded: the environment has not been reset yet, or the episode is over.
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
            reward: a number, or an array with one element.
            done: whether the episode is over (terminated or truncated).
            info: unused.

        Raises:
            InvalidArgument: the reward is not a single number.
        """
        self.count(reward_to_float(reward), bool(done))
        if done and self.autoreset:
            self.before_reset()
            self.after_reset(observation)
        return bool(done)

    def count(self, reward: float, done: bool) -> None:
        """Count a step as `after_step` does, but never start a new episode."""
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
            after_error: whether the environment has raised an exception. In that case,
                a reset is the only way to continue.
            now: the current time, if the caller has already read the clock.

        Raises:
            ResetNotAllowed: the episode has begun and is not over yet.
            ClosedError: the recorder is closed.
        """
        self._check_open()
        allowed = self.allow_early_reset or after_error
        if self.done is False and self.steps and not allowed:
            raise ResetNotAllowed(
                f"reset() was called on {self._environment} after {self.steps} steps "
                "of an episode that is not over. Continue until terminated or "
                "truncated is true, or allow early resets with allow_early_reset=True, "
                "which leaves such episodes out of the statistics."
            )
        if self.initial_reset_timestamp is None:
            self.initial_reset_timestamp = self.clock() if now is None else now

    def after_reset(self, observation: object = None) -> None:
        """Begin an episode."""
        self.steps = 0
        self.rewards = 0.0
        self.done = False
        self.episode_type = self._type

    def save_complete(self) -> None:
        """Add the running episode to the statistics as a complete episode."""
        assert self.steps is not None
        assert self.rewards is not None
        self.episode_lengths.append(self.steps)
        self.episode_rewards.append(self.rewards)
        self.episode_types.append(self.episode_type)
        self.timestamps.append(self.clock())

    def close(self) -> None:
        """Write the statistics file and close the recorder. Idempotent."""
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

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedError(f"The statistics recorder for {self.path} is closed.")


def reward_to_float(reward: Any) -> float:
    """Return a reward as a float.

    Args:
        reward: a number, a NumPy scalar or an array with one element.

    Raises:
        InvalidArgument: the reward is not a single number.
    """
    if isinstance(reward, float):  # includes NumPy's float64
        return float(reward)
    array = np.asarray(reward)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise InvalidArgument(
            f"A reward must be a single number, but it is {reward!r}. An environment "
            "with several rewards needs a wrapper that combines them into one number."
        )
    return float(array.item())

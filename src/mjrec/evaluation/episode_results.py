# SPDX-License-Identifier: Apache-2.0
"""The result of one episode of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """The result of one episode, completed or failed.

    Attributes:
        task: the environment's name.
        seed: the run's seed.
        episode: the episode's number in the run of this task and seed, from 0.
        total_reward: the return; None if the episode failed.
        length: number of steps; for a failed episode, the steps before the failure.
        terminated: whether the task ended the episode; None if it failed.
        truncated: whether a limit outside the task ended the episode; None if it
            failed.
        success: whether the environment reports a success; None if it does not report
            that.
        failure: why the episode could not be completed, in one line; None if it was
            completed.
        warnings: number of MuJoCo's warnings by kind, for kinds that occurred. Kinds
            are the names in `mujoco.mjtWarning` without `mjWARN_`.
        monitor: infix of its monitor's files; None if it failed before there was a
            monitor.
        episode_id: the episode's number in that monitor; None if it failed before the
            monitor began it.
        start_time: wall clock when the episode began, in seconds since the epoch; None
            if unknown.
        seconds: duration in seconds; None if unknown.
    """

    task: str
    seed: int
    episode: int
    total_reward: float | None
    length: int
    terminated: bool | None
    truncated: bool | None
    success: bool | None = None
    failure: str | None = None
    warnings: Mapping[str, int] = field(default_factory=dict)
    monitor: str | None = None
    episode_id: int | None = None
    start_time: float | None = None
    seconds: float | None = None

    @property
    def reward(self) -> float | None:
        """The return, under the name that keep rules use."""
        return self.total_reward

    @property
    def unit(self) -> tuple[int, int]:
        """Seed and number, which identify the episode within its task."""
        return self.seed, self.episode

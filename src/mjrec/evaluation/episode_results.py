# SPDX-License-Identifier: Apache-2.0
"""The result of one episode of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..formats.monitor_directory import Infix
from ..rendering.jobs import RecordingKey


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """The result of one episode, completed or failed.

    Attributes:
        task: the environment's name.
        seed: the run's seed.
        episode: the episode's number within its run, counted from 0. A run consists of
            the episodes of one task and seed.
        total_reward: the return; None if the episode failed.
        length: number of steps; if the episode failed, the number of steps before the
            failure.
        terminated: whether the task ended the episode; None if the episode failed.
        truncated: whether a limit outside the task ended the episode; None if the
            episode failed.
        success: whether the environment reported a success; None if it reported neither
            success nor failure.
        failure: the reason why the episode could not be completed, as a single line;
            None if it was completed.
        warnings: number of MuJoCo warnings, keyed by kind. The kinds are the names in
            `mujoco.mjtWarning` without `mjWARN_`, and only those that occurred are
            included.
        monitor: infix in the file names of the monitor that recorded the episode; None
            if the episode failed before a monitor was created.
        episode_id: the episode's number in its monitor; None if the episode failed
            before the monitor began to record it.
        start_time: when the episode began, in seconds since the Unix epoch; None if
            unknown.
        seconds: wall-clock duration in seconds; None if unknown.
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
        """The return, under the name that the keep rules expect."""
        return self.total_reward

    @property
    def unit(self) -> tuple[int, int]:
        """The seed and episode number, which identify the episode within its task."""
        return self.seed, self.episode

    @property
    def key(self) -> RecordingKey | None:
        """The key of the episode's recording; None if it was not recorded."""
        infix = Infix.parse(self.monitor or "")
        if infix is None or self.episode_id is None:
            return None
        return RecordingKey(infix, self.episode_id)

# SPDX-License-Identifier: Apache-2.0
"""The result of one episode of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """One episode, completed or failed.

    Attributes:
        task: the environment's name.
        seed: of the run.
        episode: its number in the run of that task and seed, from 0.
        total_reward: the return; None where the episode failed.
        length: number of steps; of a failed episode those until then.
        terminated: the task ended it; None where it failed.
        truncated: a limit from outside the task ended it; None where it failed.
        success: what the environment said of it; None where it said nothing.
        failure: why the episode could not be completed, in one line; None where it
            was.
        warnings: how often MuJoCo warned in it, by the names of `mujoco.mjtWarning`
            without `mjWARN_`, those that are not zero.
        monitor: the infix of its monitor's files; None where it failed before there
            was a monitor.
        episode_id: its number in that monitor; None likewise.
        start_time: wall clock when it began; None likewise.
        seconds: how long it took.
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
        """The return, as keep rules ask for it."""
        return self.total_reward

    @property
    def unit(self) -> tuple[int, int]:
        """Seed and number, which tell it from the others of its task."""
        return self.seed, self.episode

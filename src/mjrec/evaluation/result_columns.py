# SPDX-License-Identifier: Apache-2.0
"""The results of one task's episodes as columns: a million of them in 70 MB."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.monitor_directory import Infix, trajectory_prefix, video_prefix
from .episode_results import EpisodeResult

_TRUTH = {1: True, 0: False, -1: None}


@dataclass(frozen=True, kw_only=True)
class ResultColumns:
    """The episodes of one task, in the order of the plan: by seed, then by number.

    Where -1 stands, nothing is known.

    Attributes:
        task: the environment's name.
        seed: `(n,) int64`.
        episode: `(n,) int64`, the number in its run.
        total_reward: `(n,) float64`; NaN where it failed, and where that is the return.
        length: `(n,) int64`, steps.
        terminated: `(n,) int8`: 1, 0 or -1.
        truncated: `(n,) int8`, likewise.
        success: `(n,) int8`, likewise.
        failures: why, by index, of those that failed.
        start_time: `(n,) float64`, wall clock in seconds; NaN where it is not known.
        seconds: `(n,) float64`, how long it took, likewise.
        monitor: `(n,) int32`, index into `monitors`, or -1.
        monitors: the infixes of the monitors that recorded them.
        folders: of these, the monitor directories, in that of the evaluation.
        episode_id: `(n,) int64`, the number in that monitor, or -1.
        has_trajectory: `(n,) bool`.
        videos: by index, the base names of the videos of those that get one.
    """

    task: str
    seed: NDArray[np.int64]
    episode: NDArray[np.int64]
    total_reward: NDArray[np.float64]
    length: NDArray[np.int64]
    terminated: NDArray[np.int8]
    truncated: NDArray[np.int8]
    success: NDArray[np.int8]
    failures: Mapping[int, str]
    start_time: NDArray[np.float64]
    seconds: NDArray[np.float64]
    monitor: NDArray[np.int32]
    monitors: Sequence[str]
    folders: Sequence[str]
    episode_id: NDArray[np.int64]
    has_trajectory: NDArray[np.bool_]
    videos: Mapping[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seed)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """`(n,) bool`: which ones failed."""
        failed = np.zeros(len(self), dtype=np.bool_)
        failed[list(self.failures)] = True
        return failed

    def trajectory_prefix(self, index: int) -> str | None:
        """Return the base name of a trajectory without `.h5`, or None."""
        infix = self._infix(index)
        if infix is None or not self.has_trajectory[index]:
            return None
        return trajectory_prefix(infix, int(self.episode_id[index]))

    def video_prefix(self, index: int) -> str | None:
        """Return the base name that a video has, or would have, without extension."""
        infix = self._infix(index)
        if infix is None:
            return None
        return video_prefix(infix, int(self.episode_id[index]))

    def video(self, index: int, directory: Path) -> Path | None:
        """Return where a video is, or will be, in an evaluation's directory."""
        name = self.videos.get(index)
        folder = self.folders[self.monitor[index]]
        return None if name is None else directory / folder / name

    def __iter__(self) -> Iterator[EpisodeResult]:
        """Yield each episode as a result; its warnings are not in the columns."""
        return map(self._result, range(len(self)))

    def _infix(self, index: int) -> Infix | None:
        monitor = int(self.monitor[index])
        return None if monitor < 0 else Infix.parse(self.monitors[monitor])

    def _result(self, index: int) -> EpisodeResult:
        infix = self._infix(index)
        failure = self.failures.get(index)
        return EpisodeResult(
            task=self.task,
            seed=int(self.seed[index]),
            episode=int(self.episode[index]),
            total_reward=None if failure else float(self.total_reward[index]),
            length=int(self.length[index]),
            terminated=_TRUTH[int(self.terminated[index])],
            truncated=_TRUTH[int(self.truncated[index])],
            success=_TRUTH[int(self.success[index])],
            failure=failure,
            monitor=None if infix is None else str(infix),
            episode_id=None if infix is None else int(self.episode_id[index]),
            start_time=_known(self.start_time[index]),
            seconds=_known(self.seconds[index]),
        )


def _known(value: np.float64) -> float | None:
    return None if np.isnan(value) else float(value)

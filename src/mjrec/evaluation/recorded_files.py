# SPDX-License-Identifier: Apache-2.0
"""Which files of a task's monitor directory show an episode."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

from ..formats.monitor_directory import Infix, trajectory_prefix, video_prefix
from ..formats.spans import recordings_in_flight
from .episode_results import EpisodeResult
from .result_tables import EpisodeFiles

_TRAJECTORIES = (".h5",)
# Also text recordings.
_VIDEOS = (".mp4", ".json")


class RecordedFiles:
    """The files of a task, as they are when this is made.

    Args:
        folder: the task's monitor directory.
        chosen: seed and number of the episodes that are to get videos.
    """

    def __init__(self, folder: Path, chosen: Container[tuple[int, int]]) -> None:
        self._folder = folder
        self._chosen = chosen
        is_there = folder.is_dir()
        paths = list(folder.iterdir()) if is_there else []
        paths += [r.path for r in recordings_in_flight(folder)] if is_there else []
        self._names = frozenset(path.name for path in paths)

    def of(self, result: EpisodeResult) -> EpisodeFiles:
        """Return the files of an episode."""
        infix = Infix.parse(result.monitor or "")
        if infix is None or result.episode_id is None:
            return EpisodeFiles()
        trajectory = trajectory_prefix(infix, result.episode_id)
        return EpisodeFiles(
            folder=self._folder.name,
            trajectory=self._first(trajectory, _TRAJECTORIES),
            video=self._video(result, video_prefix(infix, result.episode_id)),
        )

    def _video(self, result: EpisodeResult, prefix: str) -> str | None:
        name = self._first(prefix, _VIDEOS)
        if name is not None:
            return name
        return f"{prefix}.mp4" if self._is_chosen(result) else None

    def _is_chosen(self, result: EpisodeResult) -> bool:
        return result.unit in self._chosen

    def _first(self, prefix: str, suffixes: tuple[str, ...]) -> str | None:
        names = (prefix + suffix for suffix in suffixes)
        return next((name for name in names if name in self._names), None)

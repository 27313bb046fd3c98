# SPDX-License-Identifier: Apache-2.0
"""The episodes of a directory, one after the other."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import read_journal
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import (
    Infix,
    episode_of,
    infix_of,
    is_manifest,
    iter_monitor_files,
)
from ..formats.stats_file import read_stats_file
from ..formats.trajectory_log_reader import TrajectoryLogReader

__all__ = ["Episode", "iter_episodes"]

# Videos of further cameras have the camera's name before the ending.
_VIDEO = re.compile(r".*\.video(?P<episode>\d{6,})\.(?P<kind>meta\.json|mp4|avi|json)")


@dataclass(frozen=True)
class Episode:
    """One completed episode.

    Where gym's own files do not say something, it is None.

    Attributes:
        episode_id: its number in its monitor's run; in gym's files, which have no
            numbers, its index among the completed episodes.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall clock just before the reset.
        end_time: when it ended. Wall clock, except in files of gym 0.21 and 0.22,
            which wrote seconds since some moment of their own.
        seed: as given to `reset`.
        options: as given to `reset`.
        terminated: the task ended the episode.
        truncated: a limit from outside the task ended it.
        monitor: the infix of its monitor's files.
        video: its video, where there is one.
        metadata: its video's metadata, where there is one.
        trajectory: its recorded states, where there are some; the finished file rather
            than the log.
        pending: its video is promised and not there; `mjrec render` makes it. Where a
            monitor was killed, a finished trajectory without a video counts as a
            promise, though its monitor may have recorded no videos: that stands inside
            the file, which is not opened here.
    """

    episode_id: int
    length: int
    reward: float
    type: str
    start_time: float | None
    end_time: float
    seed: Any
    options: Any
    terminated: bool | None
    truncated: bool | None
    monitor: str
    video: Path | None
    metadata: Path | None
    trajectory: Path | None = None
    pending: bool = False


class _Files:
    """The files of one monitor.

    Args:
        infix: what its files have in common.
        paths: its files.
    """

    def __init__(self, infix: str, paths: Iterable[Path]) -> None:
        self.infix = infix
        self.manifest: Path | None = None
        self.stats: Path | None = None
        self.journal: Path | None = None
        self.videos: dict[int, Path] = {}
        self.metadata: dict[int, Path] = {}
        self.trajectories: dict[int, Path] = {}
        for path in paths:
            self._sort_in(path)

    def _sort_in(self, path: Path) -> None:
        video = _VIDEO.fullmatch(path.name)
        if is_manifest(path.name):
            self.manifest = path
        elif path.name.endswith(".stats.json"):
            self.stats = path
        elif path.suffix == ".jsonl":
            self.journal = path
        elif video is not None:
            kind = self.metadata if video["kind"] == "meta.json" else self.videos
            kind[int(video["episode"])] = path
        elif path.suffix in (".h5", ".log"):
            self._sort_in_trajectory(path)

    def _sort_in_trajectory(self, path: Path) -> None:
        number = episode_of(path.name)
        if number is not None and (
            path.suffix == ".h5" or number not in self.trajectories
        ):
            self.trajectories[number] = path

    def is_pending(self, episode_id: int) -> bool:
        """Tell whether an episode's video is promised and not there."""
        trajectory = self.trajectories.get(episode_id)
        # Metadata without a video is what is left of one that could not be made.
        if trajectory is None or episode_id in (*self.videos, *self.metadata):
            return False
        details = self._details
        next_episode_id = details.get("next_episode_id")
        if isinstance(next_episode_id, int) and episode_id < next_episode_id:
            return episode_id in _pending_ids(details)
        # Its monitor is open, or was killed.
        return trajectory.suffix == ".h5" or _says_deferred(trajectory)

    @functools.cached_property
    def _details(self) -> Mapping[str, Any]:
        """What this package adds to a manifest; nothing where there is no sound one."""
        try:
            manifest = None if self.manifest is None else read_manifest(self.manifest)
        except UnreadableFile:
            return {}
        return {} if manifest is None or manifest.mjrec is None else manifest.mjrec


def _pending_ids(details: Mapping[str, Any]) -> list[Any]:
    entries = details.get("pending")
    if not isinstance(entries, list):
        return []
    return [entry.get("episode_id") for entry in entries if isinstance(entry, dict)]


def _says_deferred(log: Path) -> bool:
    try:
        with TrajectoryLogReader(log) as reader:
            video = reader.header.facts.get("video")
    except UnreadableFile:
        # Damaged, or finished just now.
        return False
    return isinstance(video, dict) and video.get("recording") == "deferred"


def iter_episodes(directory: str | os.PathLike[str]) -> Iterator[Episode]:
    """Yield the completed episodes of a directory, monitor after monitor.

    Monitors come in the order of their infix, the episodes of each in the order of
    their ends. Monitors that never closed are included, with what their journal
    holds. The episodes are read as they are asked for: a journal of any length needs
    little memory.

    Gym's files do not say which video shows which episode where an environment was
    reset twice in a row; such a monitor's episodes have None as their video.

    Raises:
        UnreadableFile: there is no such directory (at once), or a file in it is
            damaged (when it is read).
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise UnreadableFile(directory, "there is no such directory")
    return _iter_monitors(_monitors(directory))


def _iter_monitors(monitors: Iterable[_Files]) -> Iterator[Episode]:
    for files in monitors:
        if files.journal is not None:
            yield from _from_journal(files, files.journal)
        else:
            yield from _from_stats(files)


def _monitors(directory: Path) -> list[_Files]:
    grouped: dict[str, list[Path]] = {}
    for path in iter_monitor_files(directory):
        infix = infix_of(path.name)
        if infix is not None:
            grouped.setdefault(infix, []).append(path)
    return [_Files(infix, grouped[infix]) for infix in sorted(grouped, key=_order)]


def _order(infix: str) -> tuple[int, int, int, str]:
    parsed = Infix.parse(infix)
    if parsed is None:
        return (1, 0, 0, infix)
    # Process ids are numbers: 9 comes before 10.
    number = int(parsed.uid) if parsed.uid.isdecimal() else 0
    return (0, parsed.monitor_id, number, parsed.uid)


def _from_journal(files: _Files, journal: Path) -> Iterator[Episode]:
    for entry in read_journal(journal):
        yield Episode(
            episode_id=entry.episode_id,
            length=entry.length,
            reward=entry.reward,
            type=entry.type,
            start_time=entry.start_time,
            end_time=entry.end_time,
            seed=entry.seed,
            options=entry.options,
            terminated=entry.terminated,
            truncated=entry.truncated,
            monitor=files.infix,
            video=files.videos.get(entry.episode_id),
            metadata=files.metadata.get(entry.episode_id),
            trajectory=files.trajectories.get(entry.episode_id),
            pending=files.is_pending(entry.episode_id),
        )


def _from_stats(files: _Files) -> Iterator[Episode]:
    path = _stats_path(files)
    if path is None:
        return
    stats = read_stats_file(path)
    count = len(stats.timestamps)
    types = ("t",) * count if stats.episode_types is None else stats.episode_types
    # Gym noted a type at each reset, and numbered the videos by resets. One more than
    # episodes is the last one, which did not end; two more are resets in a row.
    numbered = len(types) <= count + 1
    for index in range(count):
        yield Episode(
            episode_id=index,
            length=stats.episode_lengths[index],
            reward=stats.episode_rewards[index],
            type=types[index],
            start_time=None,
            end_time=stats.timestamps[index],
            seed=None,
            options=None,
            terminated=None,
            truncated=None,
            monitor=files.infix,
            video=files.videos.get(index) if numbered else None,
            metadata=files.metadata.get(index) if numbered else None,
        )


def _stats_path(files: _Files) -> Path | None:
    if files.manifest is None:
        # A process that died between writing the two.
        return files.stats
    return files.manifest.parent / read_manifest(files.manifest).stats

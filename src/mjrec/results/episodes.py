# SPDX-License-Identifier: Apache-2.0
"""Iteration over the episodes in a directory."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import JournalEntry, read_journal
from ..formats.manifest import StatsFile
from ..formats.notebook import shown
from .journal_or_stats import MonitorResults
from .monitor_files import MonitorFiles, monitors_of


@dataclass(frozen=True, kw_only=True)
class Episode:
    """A completed episode. Facts that gym's files do not contain are None.

    Attributes:
        episode_id: the episode's number in the monitor's run, or its index in gym's
            files.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall-clock time just before the reset.
        end_time: time when the episode ended; wall-clock time, except in files from gym
            0.21 and 0.22.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        terminated: whether the task ended the episode.
        truncated: whether a limit outside the task ended the episode.
        monitor: the infix of the monitor's files.
        video: the episode's video, if it has one.
        metadata: the video's metadata, if there is a video.
        trajectory: the episode's trajectory, if it has one. If the file does not exist
            yet, `load_trajectory` reads the monitor's log.
        pending: whether the video must still be rendered (`mjrec render`).
        success: whether the environment reported success.
        evaluation: for an episode of an evaluation, its `seed`, its number in the
            evaluation (`episode`), and MuJoCo's `warnings`.
    """

    episode_id: int
    length: int
    reward: float
    type: str
    start_time: float | None = None
    end_time: float
    seed: Any = None
    options: Any = None
    terminated: bool | None = None
    truncated: bool | None = None
    monitor: str
    video: Path | None = None
    metadata: Path | None = None
    trajectory: Path | None = None
    pending: bool = False
    success: bool | None = None
    evaluation: Mapping[str, Any] | None = None

    def _repr_html_(self) -> str:
        """Show the episode's numbers and video in a notebook."""
        ended = "terminated" if self.terminated else "truncated"
        facts = {
            "steps": self.length,
            "return": self.reward,
            "ended": None if self.terminated is None else ended,
            "success": self.success,
            "seed": self.seed,
            "monitor": self.monitor,
            "video": "pending" if self.pending else None,
        }
        videos = [] if self.video is None else [self.video]
        return shown(f"Episode {self.episode_id}", facts, videos)


def iter_episodes(directory: str | os.PathLike[str]) -> Iterator[Episode]:
    """Yield the completed episodes in a directory, monitor by monitor.

    Monitors are ordered by infix, and their episodes by end time. Monitors that never
    closed are read from their journals. Episodes are read one by one, so memory use
    stays constant.

    If a journal lacks episodes that the statistics file has, the statistics file is
    used, with details from the journal. Damaged lines in a journal are skipped with a
    warning.

    If an environment was reset twice in a row, gym's files do not show which video
    belongs to which episode. Such episodes have no video. Episodes whose journal line
    is lost have no video either, and get the lowest possible number.

    Raises:
        UnreadableFile: the directory does not exist (raised immediately), or a file is
            damaged and no other file has the same episodes (raised during iteration).
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise UnreadableFile(directory, "the directory does not exist")
    return _iter_monitors(monitors_of(directory))


def _iter_monitors(monitors: Iterable[MonitorFiles]) -> Iterator[Episode]:
    for files in monitors:
        yield from episodes_of(MonitorResults(files))


def episodes_of(results: MonitorResults) -> Iterator[Episode]:
    """Yield the completed episodes of one monitor, as `iter_episodes` does.

    Raises:
        UnreadableFile: a file is damaged and no other file has the same episodes.
    """
    saved, journal, count = results.saved, results.files.journal, results.run.count
    entries: Iterable[JournalEntry] = ()
    if journal and (count or not saved):
        entries = read_journal(journal, warns=True)
    if saved is None or count >= len(saved.timestamps):
        for entry in entries:
            yield _of_journal(results, entry)
        return
    # Both files are written from the same numbers, which JSON preserves exactly.
    by_end = {(entry.end_time, entry.length): entry for entry in entries}
    number = results.details.get("first_episode_id", 0)
    is_certain = not by_end and _is_every_one(results, saved, number)
    ends = zip(saved.timestamps, saved.episode_lengths, strict=True)
    for index, end in enumerate(ends):
        known = by_end.get(end)
        if known is None:
            yield _of_stats(results, saved, index, number, is_certain=is_certain)
        else:
            yield _of_journal(results, known)
            number = known.episode_id
        number += 1


def _is_every_one(results: MonitorResults, stats: StatsFile, first: int) -> bool:
    """Return whether all episodes were completed, so that the numbers have no gaps."""
    count, following = len(stats.timestamps), results.details.get("next_episode_id")
    if results.details:
        return following is not None and following - first == count
    # gym recorded a type at each reset, and numbered videos by resets. One more type
    # than episodes means that the last episode is unfinished; two more mean two resets
    # in a row.
    return len(stats.episode_types or ()) <= count + 1


def _of_journal(results: MonitorResults, entry: JournalEntry) -> Episode:
    facts = {k: v for k, v in vars(entry).items() if k not in ("chosen", "recording")}
    return Episode(**facts, **_files(results, entry.episode_id))


def _of_stats(
    results: MonitorResults,
    stats: StatsFile,
    index: int,
    number: int,
    *,
    is_certain: bool,
) -> Episode:
    # A video must never be shown for the wrong episode.
    files = _files(results, number) if is_certain else {"monitor": results.files.infix}
    return Episode(
        episode_id=number,
        length=stats.episode_lengths[index],
        reward=stats.episode_rewards[index],
        type=stats.episode_types[index] if stats.episode_types else "t",
        end_time=stats.timestamps[index],
        **files,
    )


def _files(results: MonitorResults, number: int) -> dict[str, Any]:
    files = results.files
    video, metadata = files.videos.get(number), files.metadata.get(number)
    trajectory = files.trajectories.get(number)
    # Metadata without a video belongs to a video that could not be created.
    is_missing = trajectory is not None and video is None and metadata is None
    # A packed run may contain only the actions of an episode that was not chosen.
    packed = results.details.get("packed_episodes")
    is_left_out = isinstance(packed, list) and number not in packed
    return {
        "monitor": files.infix,
        "video": video,
        "metadata": metadata,
        "trajectory": trajectory,
        "pending": is_missing
        and not is_left_out
        and number in results.with_deferred_video,
    }

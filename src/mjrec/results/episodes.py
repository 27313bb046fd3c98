# SPDX-License-Identifier: Apache-2.0
"""The episodes of a directory, one after the other."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import MOST_EPISODES, JournalEntry, read_journal
from ..formats.spans import find_recording
from ..formats.stats_file import StatsFile
from .journal_or_stats import MonitorResults
from .monitor_files import MonitorFiles, monitors_of
from .numbering import NumberedEpisode, number_episodes


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
        trajectory: its recorded states, where there are some. The file may not be
            there yet: `load_trajectory` reads what a log has of it so far.
        pending: its video is promised and not there; `mjrec render` makes it. Where a
            monitor was killed, a finished trajectory without a video counts as a
            promise, though its monitor may have recorded no videos: that stands inside
            the file, which is not opened here.
        success: what the environment said of it; None also where nobody wrote it down.
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
    success: bool | None = None


def iter_episodes(directory: str | os.PathLike[str]) -> Iterator[Episode]:
    """Yield the completed episodes of a directory, monitor after monitor.

    Monitors come in the order of their infix, the episodes of each in the order of
    their ends. Monitors that never closed are included, with what their journal
    holds. The episodes are read as they are asked for: a journal of any length needs
    little memory.

    Where a journal lacks episodes that the statistics file has, the episodes are the
    statistics file's, and the journal adds what it says of each. What is damaged in a
    journal is left out with a warning.

    Gym's files do not say which video shows which episode where an environment was
    reset twice in a row; such a monitor's episodes have None as their video. So do
    episodes whose number is lost with their line of the journal; their `episode_id`
    is the lowest that they can have had.

    Raises:
        UnreadableFile: there is no such directory (at once), or a file in it is
            damaged and no other has the same episodes (when it is read).
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise UnreadableFile(directory, "there is no such directory")
    return _iter_monitors(monitors_of(directory))


def _iter_monitors(monitors: Iterable[MonitorFiles]) -> Iterator[Episode]:
    for files in monitors:
        yield from episodes_of(MonitorResults(files))


def episodes_of(results: MonitorResults) -> Iterator[Episode]:
    """Yield the completed episodes of one monitor, as `iter_episodes` does.

    Raises:
        UnreadableFile: its files are damaged, and no other has the same episodes.
    """
    if results.files.journal is None and not results.details:
        yield from _from_gym(results)
    elif results.journal_count >= max(results.saved_count, 0):
        yield from _from_journal(results)
    else:
        yield from _from_stats(results)


def _from_journal(results: MonitorResults) -> Iterator[Episode]:
    assert results.files.journal is not None
    for entry in read_journal(results.files.journal):
        yield _journaled(results, entry)


def _journaled(results: MonitorResults, entry: JournalEntry) -> Episode:
    files = results.files
    return Episode(
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
        pending=_is_pending(results, entry.episode_id),
        success=entry.success if isinstance(entry.success, bool) else None,
    )


def _from_stats(results: MonitorResults) -> Iterator[Episode]:
    """Yield what a statistics file of this package has and the journal lacks."""
    stats = results.saved
    if stats is None:
        return
    first = _episode_number(results.details.get("first_episode_id"))
    for numbered in number_episodes(
        stats,
        _readable_entries(results),
        first=0 if first is None else first,
        following=_episode_number(results.details.get("next_episode_id")),
    ):
        if numbered.entry is not None:
            yield _journaled(results, numbered.entry)
        else:
            yield _saved(results, stats, numbered)


def _readable_entries(results: MonitorResults) -> Iterator[JournalEntry]:
    if results.files.journal is not None and results.journal_count > 0:
        yield from read_journal(results.files.journal)


def _saved(
    results: MonitorResults, stats: StatsFile, numbered: NumberedEpisode
) -> Episode:
    number = numbered.episode_id
    # A video is never shown for another episode.
    files = results.files if numbered.is_certain else MonitorFiles("", ())
    return Episode(
        episode_id=number,
        length=stats.episode_lengths[numbered.index],
        reward=stats.episode_rewards[numbered.index],
        type=_types(stats)[numbered.index],
        start_time=None,
        end_time=stats.timestamps[numbered.index],
        seed=None,
        options=None,
        terminated=None,
        truncated=None,
        monitor=results.files.infix,
        video=files.videos.get(number),
        metadata=files.metadata.get(number),
        trajectory=files.trajectories.get(number),
        pending=numbered.is_certain and _is_pending(results, number),
    )


def _from_gym(results: MonitorResults) -> Iterator[Episode]:
    stats = results.saved
    if stats is None:
        return
    # Gym noted a type at each reset, and numbered the videos by resets. One more than
    # episodes is the last one, which did not end; two more are resets in a row.
    is_numbered = len(_types(stats)) <= len(stats.timestamps) + 1
    for index in range(len(stats.timestamps)):
        yield _saved(results, stats, NumberedEpisode(index, index, is_numbered, None))


def _types(stats: StatsFile) -> Sequence[str]:
    types = stats.episode_types
    return ("t",) * len(stats.timestamps) if types is None else types


def _is_pending(results: MonitorResults, episode_id: int) -> bool:
    """Tell whether an episode's video is promised and not there."""
    files = results.files
    trajectory = files.trajectories.get(episode_id)
    # Metadata without a video is what is left of one that could not be made.
    if trajectory is None or episode_id in files.videos or episode_id in files.metadata:
        return False
    known = _episode_number(results.details.get("next_episode_id")) or 0
    # The last one was running when the manifest was written that it outlived.
    if episode_id < known - (results.is_behind and results.saved is not None):
        return episode_id in results.pending_ids
    # Its monitor is open, or was killed.
    return trajectory.exists() or _says_deferred(trajectory)


def _episode_number(value: object) -> int | None:
    return value if type(value) is int and 0 <= value <= MOST_EPISODES else None


def _says_deferred(trajectory: Path) -> bool:
    try:
        recording = find_recording(trajectory)
    except UnreadableFile:
        return False
    video = None if recording is None else recording.facts.get("video")
    return isinstance(video, dict) and video.get("recording") == "deferred"

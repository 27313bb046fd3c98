# SPDX-License-Identifier: Apache-2.0
"""The episodes of a directory, one after the other."""

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
    """One completed episode. What gym's files do not say is None.

    Attributes:
        episode_id: its number in its monitor's run; in gym's files its index.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall clock just before the reset.
        end_time: when it ended. Wall clock, except in files of gym 0.21 and 0.22.
        seed: as given to `reset`.
        options: as given to `reset`.
        terminated: the task ended the episode.
        truncated: a limit outside the task ended it.
        monitor: infix of its monitor's files.
        video: its video, if there is one.
        metadata: its video's metadata, if there is a video.
        trajectory: its trajectory, if it has one. The file may not exist yet:
            `load_trajectory` then reads the monitor's log.
        pending: whether its video is still to be rendered (`mjrec render`).
        success: as reported by the environment.
        evaluation: in an evaluation, its `seed` and `episode` there, and MuJoCo's
            `warnings`.
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
        """Show the episode in a notebook: its numbers and its video."""
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
    """Yield the completed episodes of a directory, monitor by monitor.

    Monitors are ordered by infix, their episodes by end. Monitors that never closed are
    included, from their journals. Episodes are read one by one, so memory does not
    grow.

    If a journal lacks episodes that the statistics file has, the latter is used, and
    the journal adds what it knows. Damaged lines of a journal are left out with a
    warning.

    gym's files do not say which video belongs to which episode if an environment was
    reset twice in a row; these episodes have no video. Neither have episodes whose
    journal line is lost; they get the lowest possible number.

    Raises:
        UnreadableFile: there is no such directory (at once), or a file is damaged and
            no other has the same episodes (when it is read).
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
    saved, journal, count = results.saved, results.files.journal, results.run.count
    entries = read_journal(journal) if journal and (count or not saved) else iter(())
    if saved is None or count >= len(saved.timestamps):
        for entry in entries:
            yield _of_journal(results, entry)
        return
    # Both are written from the same numbers, which JSON gives back exactly.
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
    """Return whether every episode that began was completed, so that numbers follow."""
    count, following = len(stats.timestamps), results.details.get("next_episode_id")
    if results.details:
        return following is not None and following - first == count
    # Gym noted a type at each reset, and numbered the videos by resets. One more than
    # episodes is the last one, which did not end; two more are resets in a row.
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
    # A video is never shown for another episode.
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
    # Metadata without a video is what is left of one that could not be made.
    is_missing = trajectory is not None and video is None and metadata is None
    # A packed run may have the actions alone of an episode that was not chosen.
    packed = results.details.get("packed_episodes")
    is_left_out = isinstance(packed, list) and number not in packed
    return {
        "monitor": files.infix,
        "video": video,
        "metadata": metadata,
        "trajectory": trajectory,
        "pending": is_missing and not is_left_out and number in results.promised,
    }

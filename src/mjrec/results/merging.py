# SPDX-License-Identifier: Apache-2.0
"""Functions that merge the results of all monitors in a directory, as gym does."""

from __future__ import annotations

import itertools
import logging
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..formats.manifest import GYM_VERSION, StatsFile, read_stats_file
from .journal_or_stats import MonitorResults
from .manifest_writing import finished_and_broken
from .monitor_files import monitors_of

logger = logging.getLogger(__name__)

# The keys of gym's `load_results`, in its order.
_KEYS = (
    *("manifests", "env_info", "data_sources", "timestamps", "episode_lengths"),
    *("episode_rewards", "episode_types", "initial_reset_timestamps"),
    *("initial_reset_timestamp", "videos"),
)


class MergedStats(NamedTuple):
    """The episodes of several statistics files, ordered by end time.

    Attributes:
        data_sources: index of the file that contains each episode, which is also an
            index into `initial_reset_timestamps`.
        initial_reset_timestamps: start time of each file's first reset; None if there
            was no reset.
        timestamps: end time of each episode.
        episode_lengths: number of steps in each episode.
        episode_rewards: sum of the rewards in each episode.
        episode_types: `"t"` or `"e"` for each episode; None if no file with episodes
            has types.
        initial_reset_timestamp: time of the earliest first reset in the files with
            episodes; 0 if there is none.
    """

    data_sources: list[int]
    initial_reset_timestamps: list[float | None]
    timestamps: list[float]
    episode_lengths: list[int]
    episode_rewards: list[float]
    episode_types: list[str] | None
    initial_reset_timestamp: float


def load_results(directory: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return the merged results of all monitors in a directory.

    The dictionary has gym's keys: `manifests`, `env_info`, `data_sources`,
    `timestamps`, `episode_lengths`, `episode_rewards`, `episode_types`,
    `initial_reset_timestamps`, `initial_reset_timestamp` and `videos`. An item in
    `data_sources` is an index into `manifests` and `initial_reset_timestamps`. `videos`
    contains pairs of video path and metadata path.

    For a monitor that never closed (killed, or still open), the episodes in its journal
    are used if there are more of them than in its statistics file. If its manifest is
    missing, `manifests` lists the journal's path instead, and `videos` lists the videos
    on disk that are not broken. Damaged lines in a journal are skipped with a warning.

    If monitors recorded different environments or versions, a warning is logged, and
    `env_info` comes from the newest monitor. Missing videos are left out with a
    warning.

    Returns:
        The results, or None if the directory does not exist or contains neither a
        manifest nor a journal. In that case, an error is logged.

    Raises:
        UnreadableFile: a manifest or statistics file is missing or damaged, and there
            is no readable journal.
    """
    directory = Path(directory)
    if not directory.is_dir():
        logger.error("The directory %s does not exist.", directory)
        return None
    kept = [
        _kept(MonitorResults(files))
        for files in monitors_of(directory)
        if files.manifest or files.journal
    ]
    if not kept:
        logger.error("There are no manifests or journals in %s.", directory)
        return None
    # Sort by the names of the manifests, as gym does.
    kept.sort(key=lambda each: f"{each.infix}.manifest.json")
    found = {
        "manifests": [each.path for each in kept],
        "env_info": _env_info(directory, kept),
        **_merge([each.stats for each in kept])._asdict(),
        "videos": _videos(directory, kept),
    }
    return {key: found[key] for key in _KEYS}


def merge_stats_files(paths: Iterable[str | os.PathLike[str]]) -> MergedStats:
    """Return the episodes in statistics files, ordered by end time.

    Raises:
        UnreadableFile: a file is missing or damaged.
    """
    return _merge([read_stats_file(Path(path)) for path in paths])


class _Kept(NamedTuple):
    """The part of a monitor's results that is kept in memory during merging."""

    infix: str
    path: str
    stats: StatsFile
    env_info: Mapping[str, Any] | None
    videos: list[tuple[str, str]]


def _kept(results: MonitorResults) -> _Kept:
    return _Kept(
        infix=results.files.infix,
        path=str(results.files.manifest or results.files.journal),
        stats=results.stats(),
        env_info=results.env_info,
        videos=_names_of_videos(results),
    )


def _merge(files: Sequence[StatsFile]) -> MergedStats:
    rows = [row for source, stats in enumerate(files) for row in _rows(source, stats)]
    # NaN, which has no order, comes last.
    rows.sort(key=lambda row: (math.isnan(row[1]), row[1]))
    sources, times, lengths, rewards, types = (
        [row[column] for row in rows] for column in range(5)
    )
    with_episodes = [stats for stats in files if stats.timestamps]
    has_types = any(stats.episode_types is not None for stats in with_episodes)
    starts = [stats.initial_reset_timestamp for stats in with_episodes]
    return MergedStats(
        data_sources=sources,
        initial_reset_timestamps=[stats.initial_reset_timestamp for stats in files],
        timestamps=times,
        episode_lengths=lengths,
        episode_rewards=rewards,
        episode_types=types if has_types else None,
        initial_reset_timestamp=min(
            (start for start in starts if start is not None), default=0
        ),
    )


def _rows(source: int, stats: StatsFile) -> Iterable[tuple[Any, ...]]:
    # In files without types, every episode is a training episode. gym recorded a type
    # at each reset, even for episodes that never ended, so there may be too many types.
    types = (
        itertools.repeat("t") if stats.episode_types is None else stats.episode_types
    )
    return zip(
        itertools.repeat(source),
        stats.timestamps,
        stats.episode_lengths,
        stats.episode_rewards,
        types,
        strict=False,
    )


def _env_info(directory: Path, monitors: Sequence[_Kept]) -> dict[str, Any]:
    # A killed monitor may have left no file that contains its environment.
    known = [each for each in monitors if each.env_info is not None]
    if not known:
        return {"gym_version": GYM_VERSION}
    newest = max(known, key=lambda each: _last_time(each.stats))
    values: dict[str, list[str]] = {}
    for each in known:
        values.setdefault(repr(dict(each.env_info or {})), []).append(each.path)
    if len(values) > 1:
        logger.warning(
            "The monitors in %s recorded different environments or versions: %s. Their "
            "results are merged, and env_info is taken from %s.",
            directory,
            "; ".join(f"{Path(p[0]).name} has {value}" for value, p in values.items()),
            Path(newest.path).name,
        )
    return dict(newest.env_info or {})


def _last_time(stats: StatsFile) -> float:
    times = [*stats.timestamps, stats.initial_reset_timestamp or -math.inf]
    return max((time for time in times if not math.isnan(time)), default=-math.inf)


def _videos(directory: Path, monitors: Sequence[_Kept]) -> list[tuple[str, str]]:
    listed = [
        (directory / video, directory / metadata)
        for monitor in monitors
        for video, metadata in monitor.videos
    ]
    gone = [video.name for video, _ in listed if not video.is_file()]
    if gone:
        logger.warning(
            "%d of the %d videos listed in %s are missing and were left out: %s",
            len(gone),
            len(listed),
            directory,
            ", ".join(gone[:5]) + (" ..." if len(gone) > 5 else ""),
        )
    return [(str(v), str(m)) for v, m in listed if v.is_file()]


def _names_of_videos(results: MonitorResults) -> list[tuple[str, str]]:
    """Return the manifest's videos, or those on disk if the manifest is outdated."""
    manifest, journal = results.manifest, results.files.journal
    if manifest is not None and not results.is_behind:
        return list(dict.fromkeys(manifest.videos))
    if journal is None:
        return []
    infix = results.files.infix
    finished, _ = finished_and_broken(journal.parent, infix, results.run)
    return finished

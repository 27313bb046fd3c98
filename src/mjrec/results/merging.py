# SPDX-License-Identifier: Apache-2.0
"""The results of all monitors of a directory, merged by time as gym merged them."""

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

# Of gym's `load_results`, in its order.
_KEYS = (
    *("manifests", "env_info", "data_sources", "timestamps", "episode_lengths"),
    *("episode_rewards", "episode_types", "initial_reset_timestamps"),
    *("initial_reset_timestamp", "videos"),
)


class MergedStats(NamedTuple):
    """The episodes of several statistics files, in the order of their ends.

    Attributes:
        data_sources: for each episode the index of its file, which is also an index
            into `initial_reset_timestamps`.
        initial_reset_timestamps: for each file when its first reset began; None
            where there was none.
        timestamps: when each episode ended.
        episode_lengths: steps of each episode.
        episode_rewards: sum of the rewards of each episode.
        episode_types: `"t"` or `"e"` for each episode; None where no file with
            episodes in it has types.
        initial_reset_timestamp: the first of all, of the files with episodes in
            them; 0 where there are none.
    """

    data_sources: list[int]
    initial_reset_timestamps: list[float | None]
    timestamps: list[float]
    episode_lengths: list[int]
    episode_rewards: list[float]
    episode_types: list[str] | None
    initial_reset_timestamp: float


def load_results(directory: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return the merged results of all monitors of a directory.

    The dictionary has gym's keys: `manifests`, `env_info`, `data_sources`,
    `timestamps`, `episode_lengths`, `episode_rewards`, `episode_types`,
    `initial_reset_timestamps`, `initial_reset_timestamp` and `videos`. An item of
    `data_sources` is an index into `manifests` and `initial_reset_timestamps`. `videos`
    has pairs of video path and metadata path.

    A monitor that never closed (killed, or still open) counts with the episodes of its
    journal, if these are more than in its statistics file. Without a manifest, the
    journal's path is among `manifests`, and videos are those on disk and not broken.
    Damaged lines of a journal are left out with a warning.

    Monitors of different environments or versions give a warning, and `env_info` is the
    newest one's. Missing videos are left out with a warning.

    Returns:
        The results. None, with an error in the log, if there is no such directory or
        neither a manifest nor a journal in it.

    Raises:
        UnreadableFile: a manifest or statistics file is missing or damaged, and there
            is no readable journal.
    """
    directory = Path(directory)
    if not directory.is_dir():
        logger.error("There is no directory %s.", directory)
        return None
    monitors = [
        each for each in monitors_of(directory) if each.manifest or each.journal
    ]
    if not monitors:
        logger.error("There are no manifests in %s, and no journals.", directory)
        return None
    # In the order of the manifests' names, as gym has it.
    monitors.sort(key=lambda files: f"{files.infix}.manifest.json")
    kept = [_kept(MonitorResults(files)) for files in monitors]
    found = {
        "manifests": [each.path for each in kept],
        "env_info": _env_info(directory, kept),
        **_merge([each.stats for each in kept])._asdict(),
        "videos": _videos(directory, kept),
    }
    return {key: found[key] for key in _KEYS}


def merge_stats_files(paths: Iterable[str | os.PathLike[str]]) -> MergedStats:
    """Return the episodes of statistics files, ordered by their ends.

    Raises:
        UnreadableFile: a file is missing or damaged.
    """
    return _merge([read_stats_file(Path(path)) for path in paths])


class _Kept(NamedTuple):
    """What is kept of a monitor, of whose manifest that is a small part."""

    path: str
    stats: StatsFile
    env_info: Mapping[str, Any] | None
    videos: list[tuple[str, str]]


def _kept(results: MonitorResults) -> _Kept:
    return _Kept(
        path=str(results.files.manifest or results.files.journal),
        stats=results.stats(),
        env_info=results.env_info,
        videos=_names_of_videos(results),
    )


def _merge(files: Sequence[StatsFile]) -> MergedStats:
    rows = [row for source, stats in enumerate(files) for row in _rows(source, stats)]
    # NaN, which is not less or greater than anything, comes last.
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
    # Before there were types every episode was a training episode. Gym noted a type
    # at each reset, also of an episode that never ended, so there may be more.
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
    # Of a killed monitor there may be nothing left that says it.
    known = [each for each in monitors if each.env_info is not None]
    if not known:
        return {"gym_version": GYM_VERSION}
    newest = max(known, key=lambda each: _last_time(each.stats))
    values: dict[str, list[str]] = {}
    for each in known:
        values.setdefault(repr(dict(each.env_info or {})), []).append(each.path)
    if len(values) > 1:
        logger.warning(
            "The monitors of %s recorded different things: %s. Their results are "
            "merged; env_info is that of %s.",
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
            "%d of %d videos listed in the manifests of %s are gone and left out: %s",
            len(gone),
            len(listed),
            directory,
            ", ".join(gone[:5]) + (" ..." if len(gone) > 5 else ""),
        )
    return [(str(v), str(m)) for v, m in listed if v.is_file()]


def _names_of_videos(results: MonitorResults) -> list[tuple[str, str]]:
    """Return what the manifest lists; where it is older, what is there."""
    manifest, journal = results.manifest, results.files.journal
    if manifest is not None and not results.is_behind:
        return list(dict.fromkeys(manifest.videos))
    if journal is None:
        return []
    infix = results.files.infix
    finished, _ = finished_and_broken(journal.parent, infix, results.run)
    return finished

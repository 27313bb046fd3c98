# SPDX-License-Identifier: Apache-2.0
"""The results of all monitors of a directory, merged by time as gym merged them."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..formats.stats_file import StatsFile, read_stats_file
from ..formats.video_metadata import is_broken
from .journal_or_stats import MonitorResults
from .monitor_files import MonitorFiles, monitors_of
from .recorded_environment import GYM_VERSION

logger = logging.getLogger(__name__)


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
    """Return the results of all monitors of a directory, merged.

    The dictionary has gym's keys: `manifests`, `env_info`, `data_sources`,
    `timestamps`, `episode_lengths`, `episode_rewards`, `episode_types`,
    `initial_reset_timestamps`, `initial_reset_timestamp` and `videos`. An item of
    `data_sources` is an index into `manifests` and into `initial_reset_timestamps`.
    `videos` holds pairs of the paths of a video and its metadata.

    A monitor that never closed, because it was killed or is still open, counts with
    the complete episodes of its journal, if they are more than those of its
    statistics file; episodes are never taken from both. Where it left no manifest,
    the path of its journal stands among `manifests`; its videos are those that are
    there and not broken. What is damaged in a journal is left out with a warning.

    Monitors of several environments or versions are accepted with a warning that
    shows the difference; `env_info` is then the newest's. Listed videos that are
    gone are left out with a warning.

    Returns:
        The results, or None, with an error in the log, where there is no such
        directory, or neither a manifest nor a journal in it.

    Raises:
        UnreadableFile: a manifest or statistics file is missing or damaged, and there
            is no journal to be read in its stead.
    """
    directory = Path(directory)
    if not directory.is_dir():
        logger.error("There is no directory %s.", directory)
        return None
    monitors = [files for files in monitors_of(directory) if _has_results(files)]
    if not monitors:
        logger.error("There are no manifests in %s, and no journals.", directory)
        return None
    # In the order of the manifests' names, as gym has it.
    kept = [_kept(MonitorResults(files)) for files in sorted(monitors, key=_gyms_order)]
    merged = _merge([each.stats for each in kept])
    return {
        "manifests": [each.path for each in kept],
        "env_info": _env_info(directory, kept),
        "data_sources": merged.data_sources,
        "timestamps": merged.timestamps,
        "episode_lengths": merged.episode_lengths,
        "episode_rewards": merged.episode_rewards,
        "episode_types": merged.episode_types,
        "initial_reset_timestamps": merged.initial_reset_timestamps,
        "initial_reset_timestamp": merged.initial_reset_timestamp,
        "videos": _videos(directory, kept),
    }


def merge_stats_files(paths: Iterable[str | os.PathLike[str]]) -> MergedStats:
    """Return the episodes of statistics files, in the order of their ends.

    Episodes that ended at the same time stay in the order of their files.

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


class _Row(NamedTuple):
    source: int
    timestamp: float
    length: int
    reward: float
    type: str


def _merge(files: Sequence[StatsFile]) -> MergedStats:
    rows = [row for source, stats in enumerate(files) for row in _rows(source, stats)]
    # NaN, which is not less or greater than anything, comes last.
    rows.sort(key=lambda row: (math.isnan(row.timestamp), row.timestamp))
    with_episodes = [stats for stats in files if stats.timestamps]
    has_types = any(stats.episode_types is not None for stats in with_episodes)
    starts = [stats.initial_reset_timestamp for stats in with_episodes]
    return MergedStats(
        data_sources=[row.source for row in rows],
        initial_reset_timestamps=[stats.initial_reset_timestamp for stats in files],
        timestamps=[row.timestamp for row in rows],
        episode_lengths=[row.length for row in rows],
        episode_rewards=[row.reward for row in rows],
        episode_types=[row.type for row in rows] if has_types else None,
        initial_reset_timestamp=min(
            (start for start in starts if start is not None), default=0
        ),
    )


def _rows(source: int, stats: StatsFile) -> Iterable[_Row]:
    count = len(stats.timestamps)
    # Before there were types every episode was a training episode. Gym noted a type
    # at each reset, also of an episode that never ended.
    types = ("t",) * count if stats.episode_types is None else stats.episode_types
    return map(
        _Row._make,
        zip(
            [source] * count,
            stats.timestamps,
            stats.episode_lengths,
            stats.episode_rewards,
            types[:count],
            strict=True,
        ),
    )


def _has_results(files: MonitorFiles) -> bool:
    return files.manifest is not None or files.journal is not None


def _gyms_order(files: MonitorFiles) -> str:
    return f"{files.infix}.manifest.json"


def _env_info(directory: Path, monitors: Sequence[_Kept]) -> dict[str, Any]:
    # Of a killed monitor there may be nothing left that says it.
    known = [each for each in monitors if each.env_info is not None]
    if not known:
        return {"gym_version": GYM_VERSION}
    newest = max(known, key=lambda each: _last_time(each.stats))
    infos = [each.env_info or {} for each in known]
    if any(info != newest.env_info for info in infos):
        logger.warning(
            "The monitors of %s recorded different things: %s. Their results are "
            "merged; env_info is that of %s.",
            directory,
            _differences([each.path for each in known], infos),
            Path(newest.path).name,
        )
    return dict(newest.env_info or {})


def _last_time(stats: StatsFile) -> float:
    times = [*stats.timestamps, stats.initial_reset_timestamp or -math.inf]
    return max((time for time in times if not math.isnan(time)), default=-math.inf)


def _differences(paths: Sequence[str], infos: Sequence[Mapping[str, Any]]) -> str:
    keys = dict.fromkeys(key for info in infos for key in info)
    return "; ".join(
        text for key in keys if (text := _difference(key, paths, infos)) is not None
    )


def _difference(
    key: str, paths: Sequence[str], infos: Sequence[Mapping[str, Any]]
) -> str | None:
    values: dict[str, str] = {}
    for path, info in zip(paths, infos, strict=True):
        value = repr(info[key]) if key in info else "missing"
        values.setdefault(value, Path(path).name)
    if len(values) == 1:
        return None
    return f"{key} is " + ", ".join(f"{v} in {name}" for v, name in values.items())


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
    """Return what the manifest lists, and what was finished after it was written."""
    manifest = results.manifest
    listed = [] if manifest is None else list(manifest.videos)
    if manifest is None or results.is_behind:
        found = _finished_videos(results.files)
        # A video gets its name when it is whole, and its metadata after that.
        known = set(listed)
        listed += [pair for pair in found if pair not in known]
    return listed


def _finished_videos(files: MonitorFiles) -> list[tuple[str, str]]:
    return [
        (files.videos[number].name, files.metadata[number].name)
        for number in sorted(files.videos.keys() & files.metadata.keys())
        if not is_broken(files.metadata[number])
    ]

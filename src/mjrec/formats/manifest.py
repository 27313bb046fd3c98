# SPDX-License-Identifier: Apache-2.0
"""Gym's two files for each monitor: the manifest and the statistics.

The manifest, `openaigym.manifest.<infix>.manifest.json`, lists the files that belong to
one monitor. It is written last, so that every file it lists is complete. It contains
only base names, so the directory can be moved, and an untrusted manifest cannot point
outside its own directory.

The statistics, `openaigym.episode_batch.<infix>.stats.json`, have the keys of
`StatsFile`, in this order. The lists have one item for each completed episode. Gym
itself wrote one type for each *reset*, so its `episode_types` can be longer than the
other lists. Such a list is read unchanged.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from ..atomic_files import write_text
from ..json_text import dumps
from .json_fields import (
    base_name,
    field,
    from_json,
    integer,
    list_of,
    mapping,
    optional,
    read_object,
    unreadable,
)
from .regular_files import read_regular

# The version that is written in place of gym's version.
GYM_VERSION = "mjrec-1"


@dataclass(frozen=True)
class Manifest:
    """The content of a manifest.

    Attributes:
        stats: base name of the statistics file.
        videos: for each finished video, the base names of the video and its metadata,
            in the order of recording.
        env_info: `gym_version` and `env_id`; some versions of gym omitted one or both.
        mjrec: facts that gym did not write; None in gym's own manifests.
    """

    stats: Annotated[str, base_name]
    videos: Annotated[tuple[tuple[str, str], ...], list_of(_pair)]
    env_info: Annotated[Mapping[str, Any], mapping]
    mjrec: Annotated[Mapping[str, Any] | None, optional(_details)] = None


def read_manifest(path: Path) -> Manifest:
    """Read a manifest. Unknown keys are ignored.

    Raises:
        UnreadableFile: the file is missing or damaged, or names a file in another
            directory.
    """
    with unreadable(path):
        return from_json(Manifest, read_object(path))


def write_manifest(path: Path, manifest: Manifest) -> bool:
    """Write the manifest atomically, and return whether its content changed."""
    content = {key: value for key, value in vars(manifest).items() if value is not None}
    return _write_new(path, dumps(content))


def _write_new(path: Path, text: str) -> bool:
    with contextlib.suppress(OSError, ValueError):
        if read_regular(path, limit=len(text)) == text.encode():
            return False
    write_text(path, text)
    return True


def _pair(value: Any) -> tuple[str, str]:
    names = list_of(base_name)(value)
    if len(names) != 2:
        raise ValueError(
            f"it must name a video and its metadata, but it has {len(names)} names"
        )
    return names[0], names[1]


def _details(value: Any) -> Mapping[str, Any]:
    """Return the facts that gym did not write, after checking those that mjrec uses."""
    details = mapping(value)
    next_id = field(details, "next_episode_id", optional(integer), default=None)
    if next_id is not None and next_id < 0:
        raise ValueError(f"its 'next_episode_id' is wrong: {next_id} is negative")
    schedule = field(details, "schedule", optional(mapping), default=None)
    field(schedule or {}, "recorded", optional(list_of(integer)), default=None)
    field(details, "keep", optional(mapping), default=None)
    field(details, "faults", optional(list_of(mapping)), default=None)
    field(details, "pending", optional(list_of(mapping)), default=None)
    field(details, "broken", optional(list_of(base_name)), default=None)
    return details


@dataclass(frozen=True)
class StatsFile:
    """The content of a statistics file.

    Attributes:
        initial_reset_timestamp: time when the first reset began; None before the first
            reset.
        timestamps: time when each episode ended.
        episode_lengths: number of steps in each episode.
        episode_rewards: sum of the rewards in each episode.
        episode_types: `"t"` for training, `"e"` for evaluation; None in files from gym
            versions without types.
    """

    initial_reset_timestamp: float | None
    timestamps: tuple[float, ...]
    episode_lengths: tuple[int, ...]
    episode_rewards: tuple[float, ...]
    episode_types: tuple[str, ...] | None


def read_stats_file(path: Path) -> StatsFile:
    """Read a statistics file. A null reward becomes NaN.

    Raises:
        UnreadableFile: the file is missing or damaged, or its lists differ in length.
    """
    with unreadable(path):
        # The first versions of gym did not write these two keys.
        missing = {"initial_reset_timestamp": None, "episode_types": None}
        stats = from_json(StatsFile, {**missing, **read_object(path)})
        _check_lengths(stats)
    return stats


def write_stats_file(path: Path, stats: StatsFile) -> bool:
    """Write the statistics atomically, and return whether the content changed."""
    values = vars(stats)
    if stats.episode_types is None:
        values = {k: v for k, v in values.items() if k != "episode_types"}
    return _write_new(path, dumps(values))


def _check_lengths(stats: StatsFile) -> None:
    names = ("timestamps", "episode_lengths", "episode_rewards")
    counts = {name: len(vars(stats)[name]) for name in names}
    if len(set(counts.values())) > 1:
        each = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise ValueError(f"its lists must have the same length, but there are {each}")
    types, count = stats.episode_types, counts["timestamps"]
    if types is not None and len(types) < count:
        raise ValueError(f"it has {len(types)} episode_types for {count} episodes")

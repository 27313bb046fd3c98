# SPDX-License-Identifier: Apache-2.0
"""The manifest: which files belong to one monitor.

`openaigym.manifest.<infix>.manifest.json` is written last, so that whatever it lists
is there and whole. Names in it are base names: the directory can be moved, and a
manifest from elsewhere cannot point outside its own directory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic_files import write_text
from ..json_text import dumps
from .json_fields import (
    base_name,
    field,
    integer,
    list_of,
    mapping,
    optional,
    read_object,
    unreadable,
)

# What stands for gym's version in what this package writes.
GYM_VERSION = "mjrec-1"


@dataclass(frozen=True)
class Manifest:
    """What one manifest says.

    Attributes:
        stats: base name of the statistics file.
        videos: base names of each finished video and its metadata, in the order of
            recording.
        env_info: `gym_version` and `env_id`; some gyms left one or both out.
        mjrec: what gym did not write; None in gym's own manifests.
    """

    stats: str
    videos: tuple[tuple[str, str], ...]
    env_info: Mapping[str, Any]
    mjrec: Mapping[str, Any] | None = None


def read_manifest(path: Path) -> Manifest:
    """Return what the manifest says. Keys that nobody knows are ignored.

    Raises:
        UnreadableFile: it is missing or damaged, or names a file elsewhere.
    """
    with unreadable(path):
        values = read_object(path)
        return Manifest(
            stats=field(values, "stats", base_name),
            videos=field(values, "videos", list_of(_pair)),
            env_info=field(values, "env_info", mapping),
            mjrec=field(values, "mjrec", optional(_details), default=None),
        )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest, whole or not at all."""
    content = {key: value for key, value in vars(manifest).items() if value is not None}
    write_text(path, dumps(content))


def _pair(value: Any) -> tuple[str, str]:
    names = list_of(base_name)(value)
    if len(names) != 2:
        raise ValueError(
            f"a video and its metadata belong together, not {len(names)} names"
        )
    return names[0], names[1]


def _details(value: Any) -> Mapping[str, Any]:
    """Return what gym did not write, with what others rely on as it should be."""
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

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
        mjrec = field(values, "mjrec", optional(_details), default=None)
        return Manifest(
            stats=field(values, "stats", base_name),
            videos=field(values, "videos", list_of(_pair)),
            env_info=field(values, "env_info", mapping),
            mjrec=mjrec,
        )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest, whole or not at all.

    Raises:
        ValueError: a name in it is not a base name.
    """
    content = {
        "stats": base_name(manifest.stats),
        "videos": [[base_name(v), base_name(m)] for v, m in manifest.videos],
        "env_info": dict(manifest.env_info),
    }
    if manifest.mjrec is not None:
        content["mjrec"] = dict(manifest.mjrec)
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
    field(details, "next_episode_id", optional(_count), default=None)
    field(details, "pending", optional(list_of(mapping)), default=None)
    field(details, "broken", optional(list_of(base_name)), default=None)
    return details


def _count(value: Any) -> int:
    number = integer(value)
    if number < 0 or not isinstance(value, int):
        raise ValueError(f"{number} is no number of episodes")
    return number

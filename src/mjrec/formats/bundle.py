# SPDX-License-Identifier: Apache-2.0
"""Bundles: many finished trajectories of one monitor in one HDF5 file.

A finished trajectory is stored either in a file of its own or in a bundle,
`openaigym.trajectories.<infix>.h5`. A bundle's group `episode000027` has the same
content as the root of the file `openaigym.trajectory.<infix>.episode000027.h5`. A
trajectory is always identified by the path of its own file, even if it is in a bundle.
Use `is_finished` and `file_of` to locate it.

A bundle begins with a list of its episodes, as ranges of episode numbers. The list is
stored in the HDF5 user block::

    {"format": "mjrec trajectories", "version": 1, "episodes": [[0, 23], [25, 25]]}

Therefore, listing a directory does not require the HDF5 library.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import UnreadableFile
from ..json_text import dumps
from .json_fields import field, integer, json_object, list_of, unreadable
from .monitor_directory import (
    bundle_name,
    episode_of,
    infix_of,
    is_bundle,
    iter_monitor_files,
    trajectory_prefix,
)
from .regular_files import open_regular, regular_path
from .trajectory import check_version

FINISHED = ".h5"

_FORMAT = "mjrec trajectories"
_VERSION = 1
_MOST_EPISODES = 1_000_000
# HDF5 looks for its signature at bytes 0, 512, 1024, 2048 ...
_SMALLEST_INDEX = 512
_LONGEST_INDEX = 1 << 26
_LONGEST_RANGE = 44


def is_finished(path: Path) -> bool:
    """Return whether a finished trajectory exists, given the path of its own file."""
    return file_of(path).is_file()


def file_of(path: Path) -> Path:
    """Return the file that holds a trajectory, or `path` if there is none."""
    if not path.is_file() and path.suffix == FINISHED:
        bundle = bundle_of(path)
        if episode_of(path.name) in _episodes_in(bundle):
            return bundle
    return path


def bundle_of(path: Path) -> Path:
    """Return the path of the bundle that would hold a trajectory."""
    return path.with_name(bundle_name(infix_of(path.name) or ""))


def group_of(path: Path) -> str:
    """Return the name of a trajectory's group in its bundle."""
    return f"episode{episode_of(path.name):06d}"


def finished_trajectories(directory: Path) -> Iterator[Path]:
    """Yield the paths that identify all finished trajectories, sorted."""
    found: set[Path] = set()
    for path in iter_monitor_files(directory):
        if is_bundle(path.name):
            found.update(trajectories_in(path))
        elif path.suffix == FINISHED:
            found.add(path)
    yield from sorted(found)


def trajectories_in(bundle: Path) -> list[Path]:
    """Return the paths that identify the trajectories in a bundle, sorted.

    The list is empty if the bundle cannot be read. To get the reason, open the bundle.
    """
    infix = infix_of(bundle.name)
    if infix is None:
        return []
    return [
        bundle.with_name(f"{trajectory_prefix(infix, number)}{FINISHED}")
        for number in sorted(_episodes_in(bundle))
    ]


def index_size(count: int) -> int:
    """Return the number of bytes reserved for the index of `count` episodes."""
    needed = _SMALLEST_INDEX // 4 + _LONGEST_RANGE * count
    return max(_SMALLEST_INDEX, 1 << (needed - 1).bit_length())


def index_of(episodes: Iterable[int]) -> bytes:
    """Return the index at the beginning of a bundle's file."""
    ranges: list[list[int]] = []
    for number in sorted(episodes):
        if ranges and ranges[-1][1] == number - 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    index = {"format": _FORMAT, "version": _VERSION, "episodes": ranges}
    return dumps(index).encode() + b"\n"


def _episodes_in(bundle: Path) -> frozenset[int]:
    # Most directories have no bundle.
    if not bundle.is_file():
        return frozenset()
    try:
        with unreadable(bundle):
            status = regular_path(bundle).stat()
            version = status.st_ino, status.st_size, status.st_mtime_ns
            return _read_index(bundle, version)
    except UnreadableFile:
        return frozenset()


# Cached, because each trajectory is looked up separately.
@functools.lru_cache(maxsize=64)
def _read_index(bundle: Path, version: tuple[int, ...]) -> frozenset[int]:
    del version
    with open_regular(bundle) as file:
        index = json_object(file.readline(_LONGEST_INDEX))
    if index.get("format") != _FORMAT:
        raise ValueError("it is not a bundle of trajectories")
    check_version(field(index, "version", integer))
    numbers: set[int] = set()
    following = 0
    for first, last in field(index, "episodes", list_of(list_of(integer))):
        if not following <= first <= last:
            raise ValueError("its episodes are not in order")
        if last - first >= _MOST_EPISODES - len(numbers):
            raise ValueError(f"it has more than {_MOST_EPISODES} episodes")
        numbers.update(range(first, last + 1))
        following = last + 1
    return frozenset(numbers)

# SPDX-License-Identifier: Apache-2.0
"""Trajectories of strangers, read in a sandbox before they are read here.

A few kilobytes of HDF5 can claim any amount of memory, the same data under a million
names any amount of time, and a damaged file may crash or hang the HDF5 library. So a
file in a directory that this user has not recorded into (`model_trust`) is read once,
wholly, by a child process with limits. Where that ends well, the same file is read
here. Half a second is what that costs; one's own files cost nothing.

Logs of recordings in flight are not packed: they hold no more than their size.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from ..errors import UnreadableFile
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_file import open_trajectory
from ..sandbox import LIMITS, Sandbox, enter, is_inside
from .model_trust import is_own_directory

_MODULE = "mjrec.simulation.foreign_trajectories"

# What `load_trajectory` reads into memory: as much as that, or so many times the size
# of the file. A robot that stands still packs so well; a file that is made to fill the
# memory packs a thousandfold.
_MEMORY = 2 << 30
_MOST_EXPANSION = 64
# A file of a megabyte holds, at the most that HDF5's compression can do, a gigabyte,
# which is unpacked in some seconds.
_CPU_SECONDS = 8
_CPU_SECONDS_PER_MB = 4
# The machine may be busy with other things.
_PATIENCE = 10

_ROWS_AT_ONCE = 256
_LONGEST_REASON = 2000

# Device, inode, size and times of the files that did no harm.
_harmless: set[tuple[int, ...]] = set()


def open_vetted_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory for reading, as `open_trajectory` does, whoever made it.

    Raises:
        UnreadableFile: as `open_trajectory`; or the file is a stranger's and does harm
            to the process that reads it.
    """
    if path.is_file() and not (is_inside() or is_own_directory(path.parent)):
        identity = _identity(path)
        if identity not in _harmless:
            _vet(path)
            _harmless.add(identity)
    return open_trajectory(path)


def _vet(path: Path) -> None:
    # Holes count for nothing.
    size = min(path.stat().st_size, 512 * path.stat().st_blocks)
    memory = _MEMORY + _MOST_EXPANSION * size
    seconds = int(_CPU_SECONDS + _CPU_SECONDS_PER_MB * size / 1e6)
    limits = {**LIMITS, "RLIMIT_DATA": memory, "RLIMIT_CPU": seconds}
    with (
        tempfile.TemporaryDirectory(prefix="mjrec-reading-") as place,
        Sandbox(
            _MODULE,
            {"path": str(path.absolute())},
            place=Path(place),
            limits=limits,
            # Threads that nothing uses would take of the memory.
            more_environ={"OPENBLAS_NUM_THREADS": "1"},
        ) as sandbox,
    ):
        said = next(sandbox.said(_PATIENCE * seconds), None) or {}
        if said.get("reason"):
            raise UnreadableFile(path, str(said["reason"]))
        if not said.get("is_harmless"):
            raise UnreadableFile(
                path,
                f"the process that read it {sandbox.last_words()} (it may "
                f"use {memory / 2**30:.1f} GiB of memory and {seconds} seconds)",
            )


def _identity(path: Path) -> tuple[int, ...]:
    found = path.stat()
    return (
        *(found.st_dev, found.st_ino, found.st_size),
        *(found.st_mtime_ns, found.st_ctime_ns),
    )


def _read_through(reader: TrajectoryReader) -> None:
    """Read all that a trajectory holds, in the way in which it is used."""
    together = (
        reader.states(0, reader.row_count),
        reader.actions(0, reader.step_count),
        reader.observations(0, reader.row_count),
    )
    for start in range(0, reader.frame_count, _ROWS_AT_ONCE):
        reader.snapshots(start, min(start + _ROWS_AT_ONCE, reader.frame_count))
    for _ in reader.iter_model_changes():
        pass
    del together


def main() -> int:
    """Read the file that the parent names."""
    request, say = enter()
    path = Path(request["path"])
    try:
        with open_trajectory(path) as reader:
            _read_through(reader)
    except UnreadableFile as error:
        say(reason=error.reason[:_LONGEST_REASON])
        return 1
    say(is_harmless=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

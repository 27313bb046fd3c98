# SPDX-License-Identifier: Apache-2.0
"""Files of strangers, worked on by a process with limits: this module as a program.

A few kilobytes of HDF5 can claim any amount of memory, the same data under a million
names any amount of time, and a damaged file may crash or hang the HDF5 library. A line
of MJCF can ask for a body replicated a thousand million times. So a trajectory in a
directory that this user has not recorded into (`model_trust`) is read once, wholly, by
such a process before it is read here, and all sources of models are compiled in one.
Half a second is what that costs; one's own trajectories and models cost nothing.

Logs of recordings in flight are not packed: they hold no more than their size.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UnreadableFile
from ..formats.bundle import file_of, is_finished
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_file import open_trajectory
from ..sandbox import LIMITS, Sandbox, enter, is_inside
from .model_trust import is_own_directory

if TYPE_CHECKING:
    import mujoco

_GIB = 1 << 30
_LONGEST_REASON = 2000

# What `load_trajectory` reads into memory: as much as that, or this many times the size
# of the file. A robot that stands still packs so well; a file that is made to fill the
# memory packs a thousandfold.
_READING_MEMORY = 2 * _GIB
_MOST_EXPANSION = 64
# A file of a megabyte holds, at the most that HDF5's compression can do, a gigabyte,
# which is unpacked in some seconds of the CPU; the machine may be busy.
_CPU_SECONDS = 8
_CPU_SECONDS_PER_MB = 4
_SECONDS_PER_CPU_SECOND = 10
_ROWS_AT_ONCE = 256

# The largest robots and rooms of the field compile in seconds.
_COMPILING_SECONDS = 300.0
# Python, MuJoCo and what they need for threads, and then some room.
_COMPILING_MEMORY = 6 * _GIB
_MEMORY_FACTOR = 8
_COMPILED = "model.mjb"

# Name, device, inode, size and times of the files that did no harm.
_harmless: set[tuple[str | int, ...]] = set()


def open_vetted_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory for reading, as `open_trajectory` does, also a stranger's.

    Raises:
        UnreadableFile: as `open_trajectory`; or the file is a stranger's and does harm
            to the process that reads it.
    """
    if is_finished(path) and not (is_inside() or is_own_directory(path.parent)):
        found = file_of(path).stat()
        times = (found.st_mtime_ns, found.st_ctime_ns)
        identity = (path.name, found.st_dev, found.st_ino, found.st_size, *times)
        if identity not in _harmless:
            # Holes count for nothing.
            size = min(found.st_size, 512 * found.st_blocks)
            cpu_seconds = int(_CPU_SECONDS + _CPU_SECONDS_PER_MB * size / 1e6)
            memory = _READING_MEMORY + _MOST_EXPANSION * size
            limits = {"RLIMIT_DATA": memory, "RLIMIT_CPU": cpu_seconds}
            with _done("read", path, limits, _SECONDS_PER_CPU_SECOND * cpu_seconds):
                _harmless.add(identity)
    return open_trajectory(path)


def compile_sources(
    path: Path, *, compiled_size: int, seconds: float = _COMPILING_SECONDS
) -> mujoco.MjModel:
    """Return the model that `write_authored` was given, compiled by this MuJoCo.

    Args:
        path: of the zip.
        compiled_size: of the model when it was recorded, by which it is judged how
            much memory compiling may take.
        seconds: how long it may take.

    Raises:
        UnreadableFile: it is damaged or dangerous, this MuJoCo refuses it, or it needs
            more time or memory than that.
    """
    # Here, because reading trajectories needs no simulator.
    import mujoco

    memory = _COMPILING_MEMORY + _MEMORY_FACTOR * compiled_size
    limits = {"RLIMIT_AS": memory, "RLIMIT_DATA": memory}
    with _done("compile", path, limits, seconds) as place:
        return mujoco.MjModel.from_binary_path(str(place / _COMPILED))


@contextlib.contextmanager
def _done(
    task: str, path: Path, limits: dict[str, int], seconds: float
) -> Iterator[Path]:
    """Let a process with limits do something with a file; yield what it left behind.

    Raises:
        UnreadableFile: it could not, or not in that time.
    """
    with (
        tempfile.TemporaryDirectory(prefix="mjrec-sandbox-") as place,
        Sandbox(
            __name__,
            {"task": task, "path": str(path.absolute())},
            place=Path(place),
            limits={**LIMITS, **limits},
            # Threads that nothing uses would take of the memory.
            more_environ={"OPENBLAS_NUM_THREADS": "1"},
        ) as sandbox,
    ):
        answer = next(sandbox.answers(seconds), {})
        if answer is None:
            reason = f"to {task} it takes longer than {seconds:g} seconds"
            raise UnreadableFile(path, reason)
        if "done" not in answer:
            raise UnreadableFile(
                path,
                answer.get("reason")
                or f"the process that was to {task} it {sandbox.last_words()} (it may "
                f"use {limits['RLIMIT_DATA'] / _GIB:.1f} GiB of memory)",
            )
        yield Path(place)


def main() -> int:
    """Do what the parent asks for."""
    request, say = enter()
    try:
        {"read": _read, "compile": _compile}[request["task"]](Path(request["path"]))
    except UnreadableFile as error:
        say(reason=error.reason[:_LONGEST_REASON])
        return 1
    say(done=True)
    return 0


def _read(path: Path) -> None:
    """Read all that a trajectory holds, in the way in which it is used."""
    with open_trajectory(path) as reader:
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


def _compile(path: Path) -> None:
    # Here, because reading trajectories needs no simulator.
    import mujoco

    from .model_sources import read_authored

    mujoco.mj_saveModel(read_authored(path), _COMPILED)


if __name__ == "__main__":
    sys.exit(main())

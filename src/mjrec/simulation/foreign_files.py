# SPDX-License-Identifier: Apache-2.0
"""A resource-limited process that reads untrusted files, and the program that it runs.

A few kilobytes of HDF5 can claim any amount of memory. Reading the same data under a
million names can take any amount of time. A damaged file may crash or hang the HDF5
library. One line of MJCF can request a billion copies of a body.

So unless this user has recorded into a trajectory's directory (see `model_trust`), a
limited process first reads the whole trajectory. All model sources are also compiled in
a limited process. This takes half a second. The user's own trajectories and models need
no check.

Logs of recordings in flight are not compressed, so reading them takes no more memory
than their size.
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

# Memory for the data that `load_trajectory` reads: a fixed amount, plus a multiple of
# the file size. A recording of a robot at rest compresses that well, but a file made to
# exhaust memory compresses a thousandfold.
_READING_MEMORY = 2 * _GIB
_MOST_EXPANSION = 64
# A megabyte of HDF5 unpacks to at most a gigabyte. This takes a few seconds of CPU
# time, and the machine may be busy.
_CPU_SECONDS = 8
_CPU_SECONDS_PER_MB = 4
_SECONDS_PER_CPU_SECOND = 10
_ROWS_AT_ONCE = 256

# Even the largest robots and rooms compile in seconds.
_COMPILING_SECONDS = 300.0
# Enough for Python, MuJoCo and their threads, with room to spare.
_COMPILING_MEMORY = 6 * _GIB
_MEMORY_FACTOR = 8
_COMPILED = "model.mjb"

# Name, device, inode, size and times of files that proved harmless.
_harmless: set[tuple[str | int, ...]] = set()


def open_vetted_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory as `open_trajectory` does, but test untrusted files first.

    Raises:
        UnreadableFile: see `open_trajectory`. This is also raised if the limited
            process fails to read an untrusted file.
    """
    if is_finished(path) and not (is_inside() or is_own_directory(path.parent)):
        found = file_of(path).stat()
        times = (found.st_mtime_ns, found.st_ctime_ns)
        identity = (path.name, found.st_dev, found.st_ino, found.st_size, *times)
        if identity not in _harmless:
            # Holes in a sparse file do not count.
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
    """Return the model passed to `write_authored`, compiled by the installed MuJoCo.

    Args:
        path: the zip file.
        compiled_size: the recorded size of the compiled model in bytes, which
            determines the memory limit.
        seconds: the time limit.

    Raises:
        UnreadableFile: the file is damaged or dangerous, MuJoCo rejects it, or
            compiling exceeds the time or memory limit.
    """
    # Imported here, because reading trajectories needs no simulator.
    import mujoco

    memory = _COMPILING_MEMORY + _MEMORY_FACTOR * compiled_size
    limits = {"RLIMIT_AS": memory, "RLIMIT_DATA": memory}
    with _done("compile", path, limits, seconds) as place:
        return mujoco.MjModel.from_binary_path(str(place / _COMPILED))


@contextlib.contextmanager
def _done(
    task: str, path: Path, limits: dict[str, int], seconds: float
) -> Iterator[Path]:
    """Run a task on a file in a limited process, and yield the output directory.

    Raises:
        UnreadableFile: the task failed or took too long.
    """
    with (
        tempfile.TemporaryDirectory(prefix="mjrec-sandbox-") as place,
        Sandbox(
            __name__,
            {"task": task, "path": str(path.absolute())},
            place=Path(place),
            limits={**LIMITS, **limits},
            # Unused threads would take up memory.
            more_environ={"OPENBLAS_NUM_THREADS": "1"},
        ) as sandbox,
    ):
        answer = next(sandbox.answers(seconds), {})
        if answer is None:
            reason = f"it takes longer than {seconds:g} seconds to {task} it"
            raise UnreadableFile(path, reason)
        if "done" not in answer:
            raise UnreadableFile(
                path,
                answer.get("reason")
                or f"the process that tried to {task} it {sandbox.last_words()} (the "
                f"memory limit is {limits['RLIMIT_DATA'] / _GIB:.1f} GiB)",
            )
        yield Path(place)


def main() -> int:
    """Run the task that the parent requests."""
    request, say = enter()
    try:
        {"read": _read, "compile": _compile}[request["task"]](Path(request["path"]))
    except UnreadableFile as error:
        say(reason=error.reason[:_LONGEST_REASON])
        return 1
    say(done=True)
    return 0


def _read(path: Path) -> None:
    """Read a whole trajectory, as a normal reader would."""
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
    # Imported here, because reading trajectories needs no simulator.
    import mujoco

    from .model_sources import read_authored

    mujoco.mj_saveModel(read_authored(path), _COMPILED)


if __name__ == "__main__":
    sys.exit(main())

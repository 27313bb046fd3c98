# SPDX-License-Identifier: Apache-2.0
"""Compiling what a recorded model was made from, within bounds of time and memory.

A line of MJCF can ask for anything: a body replicated a thousand million times, a
texture of ten gigabytes, an object that takes days to compile. So it is done in a
process of its own, which has a limit of memory and is ended when it takes too long, and
whose death is an error and not this process's end too. Half a second is what that
costs; it is needed only where the compiled model cannot be used.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import mujoco

from ..child_python import environment_of_child, python_command
from ..errors import UnreadableFile
from .authored_model import read_authored

_MODEL = "model.mjb"
_REASON = "reason.txt"
_LONGEST_REASON = 2000

# The largest robots and rooms of the field compile in seconds.
_SECONDS = 300.0
# Python, MuJoCo and what they need for threads, and then some room.
_BASE_MEMORY = 6 << 30
_MEMORY_FACTOR = 8


def compile_within(
    path: Path, *, limit: int, compiled_size: int, seconds: float = _SECONDS
) -> mujoco.MjModel:
    """Return the model that `write_authored` was given, compiled by this MuJoCo.

    Args:
        path: of the zip.
        limit: how many bytes its content may have.
        compiled_size: of the model when it was recorded, by which it is judged how
            much memory compiling may take.
        seconds: how long it may take.

    Raises:
        UnreadableFile: it is damaged or dangerous, this MuJoCo refuses it, or it needs
            more time or memory than that.
    """
    memory = _BASE_MEMORY + _MEMORY_FACTOR * compiled_size
    with tempfile.TemporaryDirectory(prefix="mjrec-model-") as directory:
        place = Path(directory)
        arguments = [str(path.absolute()), directory, str(limit), str(memory)]
        try:
            done = subprocess.run(
                [*python_command("mjrec.simulation.source_compiler"), *arguments],
                # Where what it leaves behind is removed, MuJoCo's own log included.
                cwd=directory,
                env=environment_of_child({**os.environ, "TMPDIR": directory}),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise UnreadableFile(
                path, f"compiling it takes longer than {seconds:g} seconds"
            ) from error
        except OSError as error:
            raise UnreadableFile(
                path, f"no process could be started that compiles it ({error})"
            ) from error
        if done.returncode:
            raise UnreadableFile(
                path, _reason(place / _REASON, done.returncode, memory)
            )
        return mujoco.MjModel.from_binary_path(str(place / _MODEL))


def main(arguments: Sequence[str]) -> int:
    """Compile a zip; the model, or the reason why there is none, becomes a file."""
    path, place = Path(arguments[0]), Path(arguments[1])
    limit, memory = int(arguments[2]), int(arguments[3])
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    allowed = memory if most == resource.RLIM_INFINITY else min(memory, most)
    resource.setrlimit(resource.RLIMIT_AS, (allowed, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        model = read_authored(path, limit=limit)
        mujoco.mj_saveModel(model, str(place / _MODEL))
    except UnreadableFile as error:
        (place / _REASON).write_text(error.reason[:_LONGEST_REASON], encoding="utf-8")
        return 1
    return 0


def _reason(said: Path, returncode: int, memory: int) -> str:
    if said.exists():
        return said.read_text(encoding="utf-8")
    how = signal.Signals(-returncode).name if returncode < 0 else f"status {returncode}"
    return (
        f"the process that compiled it ended ({how}); it may use "
        f"{memory / 2**30:.1f} GiB of memory"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

# SPDX-License-Identifier: Apache-2.0
"""Compiling what a recorded model was made from, within bounds of time and memory.

A line of MJCF can ask for anything: a body replicated a thousand million times, a
texture of ten gigabytes, an object that takes days to compile. So it is done in a
sandbox. Half a second is what that costs; it is needed only where the compiled model
cannot be used.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import mujoco

from ..errors import UnreadableFile
from ..sandbox import LIMITS, Sandbox, enter
from .authored_model import read_authored

_MODULE = "mjrec.simulation.source_compiler"
_COMPILED = "model.mjb"
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
    limits = {**LIMITS, "RLIMIT_AS": memory, "RLIMIT_DATA": memory}
    request = {"path": str(path.absolute()), "limit": limit}
    with tempfile.TemporaryDirectory(prefix="mjrec-model-") as directory:
        place = Path(directory)
        with Sandbox(_MODULE, request, place=place, limits=limits) as sandbox:
            for said in sandbox.said(seconds):
                if said is None:
                    raise UnreadableFile(
                        path, f"compiling it takes longer than {seconds:g} seconds"
                    )
                if "reason" in said:
                    raise UnreadableFile(path, str(said["reason"]))
                if "compiled" in said:
                    return mujoco.MjModel.from_binary_path(str(place / _COMPILED))
            raise UnreadableFile(
                path,
                f"the process that compiled it {sandbox.last_words()} (it may "
                f"use {memory / 2**30:.1f} GiB of memory)",
            )


def main() -> int:
    """Compile the zip that the parent names."""
    request, say = enter()
    try:
        model = read_authored(Path(request["path"]), limit=request["limit"])
        mujoco.mj_saveModel(model, _COMPILED)
    except UnreadableFile as error:
        say(reason=error.reason[:_LONGEST_REASON])
        return 1
    say(compiled=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Running a module of ours in a Python process of its own.

Not with multiprocessing, whose children import the caller's main module (a script
without a guard would run again), cannot be started from daemonic processes, and with
"fork" inherit OpenGL's locks without its threads.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

logger = logging.getLogger(__name__)

MOST_OF_STACKS = 20_000
_STACKS = signal.SIGUSR1
_LOOKS_FOR_STACKS = 20
_SECONDS_BETWEEN_LOOKS = 0.1


def python_command(module: str) -> list[str]:
    """Return the command that runs `module`, which finds what this process finds.

    To be run with `environment_of_child`. `-P` keeps the working directory, which may
    hold a file called `random.py`, from being searched first.
    """
    return [sys.executable, "-P", "-m", module]


def environment_of_child(environ: Mapping[str, str]) -> dict[str, str]:
    """Return `environ` with this process's module search path in `PYTHONPATH`.

    The whole of it, in its order, so that the child has the same mujoco and the same
    mjrec, by whatever means this process came to them. The directory of the main
    script, or the working directory, which Python puts first, is searched last.
    """
    first, rest = sys.path[:1], sys.path[1:]
    path = [*rest, *first] if first and _is_of_main(first[0]) else sys.path
    entries = (str(Path(entry).absolute()) for entry in path if isinstance(entry, str))
    # What has the separator in its name cannot be said there.
    entries_said = [entry for entry in entries if os.pathsep not in entry]
    return {**environ, "PYTHONPATH": os.pathsep.join(entries_said)}


def take_standard_output() -> int:
    """Return a descriptor of the standard output, for what is said to the parent.

    From here on the standard output is the standard error: libraries and drivers print
    whenever they like. Children do not get the descriptor.
    """
    sys.stdout.flush()
    descriptor = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return descriptor


def say_stacks_when_asked() -> None:
    """Let this process write what its threads are at to the standard error.

    At `ask_for_stacks`, whatever it hangs in, and when it dies of a signal such as
    SIGSEGV.
    """
    faulthandler.enable()
    faulthandler.register(_STACKS)


def ask_for_stacks(pid: int) -> None:
    """Let a child that hangs say where. One that has not begun yet dies of it."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, _STACKS)
        # Should it only have been stopped.
        os.kill(pid, signal.SIGCONT)


def stacks_said_in(words: IO[bytes], pid: int) -> str:
    """Return where a child hangs, for the log.

    Args:
        words: the file that its standard error is. It is read beside its position,
            which is the child's too.
        pid: the child's number.
    """
    descriptor = words.fileno()
    before = os.fstat(descriptor).st_size
    ask_for_stacks(pid)
    after = before
    for _ in range(_LOOKS_FOR_STACKS):
        time.sleep(_SECONDS_BETWEEN_LOOKS)
        size = os.fstat(descriptor).st_size
        if size == after > before:
            break
        after = size
    return stacks_in(os.pread(descriptor, MOST_OF_STACKS, before))


def stacks_in(said: bytes) -> str:
    """Return what a child has said of where it hangs, as text."""
    return said.decode(errors="replace").strip() or "(it does not say)"


def how_it_ended(status: int) -> str:
    """Return in words the exit status of a process, as `subprocess` gives it."""
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"was killed by signal {-status}"


def said_in(line: bytes) -> dict[str, Any]:
    """Return what a child has said in a line; nothing if that is no JSON object."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        said = None
    if isinstance(said, dict):
        return said
    logger.warning("A process of mjrec's said what is not understood: %.200r", line)
    return {}


def _is_of_main(entry: str) -> bool:
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    return entry == "" or (
        file is not None and Path(entry).resolve() == Path(file).resolve().parent
    )

# SPDX-License-Identifier: Apache-2.0
"""Child processes: finding, killing and forking them."""

import functools
import os
import re
import signal
import time
from pathlib import Path


def children(of="self"):
    """Return a process's children, zombies too, but not multiprocessing's helpers."""
    own = re.compile(b"resource_tracker|forkserver")
    while True:
        try:
            return {
                int(pid)
                for thread in Path(f"/proc/{of}/task").iterdir()
                for pid in (thread / "children").read_text().split()
                if not own.search(Path("/proc", pid, "cmdline").read_bytes())
            }
        except (FileNotFoundError, ProcessLookupError):
            # A thread or child ended meanwhile; a thread's children go to another.
            continue


def kill_children(name):
    """Kill this process's children of that name, and return their number.

    It waits for the first, as a new child still has its parent's name.
    """
    deadline = time.monotonic() + 10
    named = []
    while not named and time.monotonic() < deadline:
        named = [p for p in children() if name in Path(f"/proc/{p}/comm").read_text()]
    for pid in named:
        os.kill(pid, signal.SIGKILL)
    return len(named)


def forked(child):
    """Run a function in a forked process, and wait for its end.

    Args:
        child: a function of a callback, which it calls to count its steps.

    Returns:
        The number of calls of the callback, and the status of the process.
    """
    incoming, outgoing = os.pipe()
    # This keeps the original `os.write` when the child patches it.
    count = functools.partial(os.write, outgoing, b".")
    process = os.fork()
    if process == 0:
        try:
            child(count)
        finally:
            os._exit(1)
    os.close(outgoing)
    with os.fdopen(incoming, "rb") as pipe:
        calls = len(pipe.read())
    _, status = os.waitpid(process, 0)
    return calls, status


def kill_self(*_):
    """Kill this process as the kernel does when memory is short."""
    os.kill(os.getpid(), signal.SIGKILL)

# SPDX-License-Identifier: Apache-2.0
"""The processes that a process, mostly the tests' own, has started."""

import functools
import os
import re
import signal
import time
from pathlib import Path


def children(of="self"):
    """Return those that are still there, zombies too, but not multiprocessing's own."""
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
            # A thread or a child ended meanwhile; a thread's children went to another.
            continue


def kill_children(name):
    """Kill this process's children of that name, and return how many there were.

    One that was started just now has its parent's name for a moment.
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
        child: what it does; it calls what it is given to say that it has come so far.

    Returns:
        How often it did, and the status that the process ended with.
    """
    incoming, outgoing = os.pipe()
    # Whatever becomes of `os.write` in the process.
    tell = functools.partial(os.write, outgoing, b".")
    process = os.fork()
    if process == 0:
        try:
            child(tell)
        finally:
            os._exit(1)
    os.close(outgoing)
    with os.fdopen(incoming, "rb") as said:
        far = len(said.read())
    _, status = os.waitpid(process, 0)
    return far, status


def kill_self(*_):
    """End this process as the kernel does where memory is short."""
    os.kill(os.getpid(), signal.SIGKILL)

# SPDX-License-Identifier: Apache-2.0
"""The processes that a process, mostly the tests' own, has started."""

from __future__ import annotations

from pathlib import Path


def children(of: int | str = "self") -> set[int]:
    """Return those that are still there, be it as zombies.

    Without the one in which multiprocessing tracks what processes share: it starts
    it with the first process that it spawns, and keeps it to the very end.
    """
    while True:
        try:
            return {
                int(pid)
                for thread in Path(f"/proc/{of}/task").iterdir()
                for pid in (thread / "children").read_text().split()
                if b"resource_tracker" not in Path("/proc", pid, "cmdline").read_bytes()
            }
        except (FileNotFoundError, ProcessLookupError):
            # A thread or a child ended meanwhile; a thread's children went to another.
            continue

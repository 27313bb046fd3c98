# SPDX-License-Identifier: Apache-2.0
"""The processes that the tests' own process has started."""

from __future__ import annotations

from pathlib import Path


def children() -> set[int]:
    """Return those that are still there, be it as zombies.

    Without the one in which multiprocessing tracks what processes share: it starts
    it with the first process that it spawns, and keeps it to the very end.
    """
    while True:
        try:
            return {
                int(pid)
                for thread in Path("/proc/self/task").iterdir()
                for pid in (thread / "children").read_text().split()
                if b"resource_tracker" not in Path("/proc", pid, "cmdline").read_bytes()
            }
        except (FileNotFoundError, ProcessLookupError):
            # A thread or a child ended meanwhile; a thread's children went to another.
            continue

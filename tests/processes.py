# SPDX-License-Identifier: Apache-2.0
"""The processes that the tests' own process has started."""

from __future__ import annotations

from pathlib import Path


def children() -> set[int]:
    """Return those that are still there, be it as zombies."""
    while True:
        try:
            return {
                int(pid)
                for thread in Path("/proc/self/task").iterdir()
                for pid in (thread / "children").read_text().split()
            }
        except (FileNotFoundError, ProcessLookupError):
            # A thread ended meanwhile, and its children went to another: look again.
            continue

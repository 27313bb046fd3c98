# SPDX-License-Identifier: Apache-2.0
"""A driver's sign of life in the folder of its run."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from pathlib import Path
from typing import Any

from ..child_python import said_in
from .job_folder import JobFolder

_BOOT = Path("/proc/sys/kernel/random/boot_id")
_PIDS = Path("/proc/self/ns/pid")
_FACTS = ("machine", "pid", "started")
# Fields of /proc/<pid>/stat after the name.
_ZOMBIE = "Z"
_START = 19


class DriverSign:
    """Gives signs of life on a thread, because the driver may be busy elsewhere.

    Args:
        folder: of the run.
        cluster: that its jobs are on.
        every_s: how often.
    """

    def __init__(self, folder: JobFolder, cluster: str, *, every_s: float) -> None:
        self._folder = folder
        self._facts = {"cluster": cluster, **_facts_of(os.getpid())}
        self._every_s = every_s
        self._count = 0
        self._over = threading.Event()
        self._give()
        self._thread = threading.Thread(
            target=self._go_on, name="mjrec-driver-sign", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Give no more. Idempotent."""
        self._over.set()
        self._thread.join()

    def _go_on(self) -> None:
        while not self._over.wait(self._every_s):
            # The next one may do better.
            with contextlib.suppress(OSError):
                self._give()

    def _give(self) -> None:
        self._count += 1
        self._folder.give_sign(json.dumps({**self._facts, "count": self._count}))


def is_surely_dead(sign: bytes) -> bool:
    """Return whether the driver that gave a sign was on this machine, and is dead."""
    said = said_in(sign) if sign else {}
    if said.get("machine") != _machine():
        return False
    try:
        return bool(_facts_of(said["pid"]) != {name: said[name] for name in _FACTS})
    except (OSError, KeyError):
        return True


def _facts_of(pid: int) -> dict[str, Any]:
    """Return what tells a process from all others, of all machines.

    Raises:
        OSError: there is no such process.
    """
    # What comes before, in brackets, is the program's name: it may hold anything.
    fields = Path("/proc", str(pid), "stat").read_text().rpartition(")")[2].split()
    if fields[0] == _ZOMBIE:
        raise ProcessLookupError(pid)
    return {"machine": _machine(), "pid": pid, "started": fields[_START]}


def _machine() -> str:
    """Return what tells those apart that count processes of their own."""
    return f"{_BOOT.read_text().strip()} {_PIDS.readlink()}"

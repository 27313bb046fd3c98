# SPDX-License-Identifier: Apache-2.0
"""The machine's CPUs, shared by everybody who renders into one directory.

A CPU is a lock file, `.openaigym.render.<number>.lock`; whoever holds it may keep one
worker busy. Eight environments in eight processes that record into one directory on a
machine with two CPUs so have two workers between them, not sixteen.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from ..errors import DirectoryNotWritable, InvalidArgument
from ..formats.locks import Lock, try_lock
from ..formats.monitor_directory import render_lock_name
from ..machine import usable_cpus

_SECONDS_BETWEEN_TRIES = 0.1


class CpuSlots:
    """The CPUs of a directory, as far as this process holds them.

    Args:
        directory: the monitor directory.
        total: how many there are; those that this process can keep busy, if None.
        wait: called with seconds to wait while all are in other hands.

    Attributes:
        total: how many there are.
    """

    def __init__(
        self,
        directory: Path,
        *,
        total: int | None = None,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self.total = usable_cpus() if total is None else total
        self._directory = directory
        self._wait = wait
        self._held: dict[int, Lock] = {}

    @property
    def held(self) -> int:
        """How many this process holds."""
        return len(self._held)

    def take(self, most: int) -> int:
        """Take what is free, up to `most` in all, and return how many are held now.

        Waits until there is one. Those that are held already count.

        Raises:
            DirectoryNotWritable: there can be no lock in the directory.
        """
        most = max(1, min(most, self.total))
        self._take_free(most)
        while not self._held:
            self._wait(_SECONDS_BETWEEN_TRIES)
            self._take_free(most)
        return self.held

    def give_back(self) -> None:
        """Let all of them go. Idempotent."""
        while self._held:
            _, lock = self._held.popitem()
            lock.release()

    def _take_free(self, most: int) -> None:
        for number in range(self.total):
            if len(self._held) >= most:
                return
            if number not in self._held:
                lock = self._try(number)
                if lock is not None:
                    self._held[number] = lock

    def _try(self, number: int) -> Lock | None:
        try:
            return try_lock(
                self._directory / render_lock_name(number), f"{os.getpid()}\n"
            )
        except OSError as error:
            raise DirectoryNotWritable(self._directory, error.strerror) from error


def check_workers(workers: int | None) -> int | None:
    """Return `workers` if it is a number of processes, or None.

    Raises:
        InvalidArgument: it is something else.
    """
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if workers is not None and not (whole and workers >= 1):
        raise InvalidArgument(
            "workers must be a positive whole number, or None for one on each CPU that "
            f"can be used, got {workers!r}."
        )
    return workers

# SPDX-License-Identifier: Apache-2.0
"""The machine's CPUs, shared by all processes that render into one directory.

A CPU is a lock file, `.openaigym.render.<number>.lock`; the process that holds it may
keep one worker busy. Eight environments in eight processes that record into one
directory on a machine with two CPUs so have two workers at work, not sixteen.
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
from .pool import WorkerPool

_SECONDS_BETWEEN_TRIES = 0.1


class SharedPool:
    """A pool of workers, of which as many draw as CPUs of the directory are free.

    The workers stay from video to video; only how many of them draw changes.

    Args:
        directory: the monitor directory.
        workers: how many, whatever is free; None is one for each free CPU.
        wait: called with seconds to wait while no CPU is free.

    Raises:
        InvalidArgument: `workers` is no number of processes.
    """

    def __init__(
        self,
        directory: Path,
        *,
        workers: int | None,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self._fixed = check_workers(workers)
        self._slots = CpuSlots(directory, wait=wait)
        self._pool: WorkerPool | None = None

    def at_work(self) -> WorkerPool:
        """Return the workers, to be used until the next call of any method.

        Waits for a free CPU, unless a number of workers was asked for.
        """
        limit = self._fixed or self._slots.take(self._slots.total)
        if self._pool is None:
            self._pool = WorkerPool(self._fixed or self._slots.total)
        self._pool.limit = limit
        return self._pool

    def rest(self) -> None:
        """Give the CPUs back: there is nothing to draw. The workers stay."""
        self._slots.give_back()

    def close(self) -> None:
        """End the workers at once and give the CPUs back. Idempotent."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None
        self.rest()


class CpuSlots:
    """The CPUs of a directory, as far as this process holds them.

    Args:
        directory: the monitor directory.
        total: how many there are; those that this process can keep busy, if None.
        wait: called with seconds to wait while none is free.

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

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
        self._count = self._fixed or usable_cpus()
        self._directory = directory
        self._wait = wait
        # The CPUs that this process holds.
        self._held: dict[int, Lock] = {}
        self._pool: WorkerPool | None = None

    def start(self) -> None:
        """Start the workers: soon there is something to draw. Idempotent.

        Raises:
            DirectoryNotWritable, Error, GLError: as `at_work`, or `WorkerPool.start`.
        """
        if self._pool is None and (limit := self._free()):
            self._made(limit).start()
            self.rest()

    def at_work(self) -> WorkerPool:
        """Return the workers, to be used until the next call of any method.

        Waits for a free CPU, unless a number of workers was asked for.

        Raises:
            DirectoryNotWritable: there can be no lock in the directory.
        """
        while not (limit := self._free()):
            self._wait(_SECONDS_BETWEEN_TRIES)
        return self._made(limit)

    def rest(self) -> None:
        """Give the CPUs back: there is nothing to draw. The workers stay."""
        while self._held:
            _, lock = self._held.popitem()
            lock.release()

    def close(self) -> None:
        """End the workers at once and give the CPUs back. Idempotent."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None
        self.rest()

    def _made(self, limit: int) -> WorkerPool:
        self._pool = self._pool or WorkerPool(self._count)
        self._pool.limit = limit
        return self._pool

    def _free(self) -> int:
        """Take the CPUs that are free; return how many workers may draw."""
        if self._fixed is not None:
            return self._fixed
        for number in range(self._count):
            if number not in self._held:
                path = self._directory / render_lock_name(number)
                try:
                    lock = try_lock(path, f"{os.getpid()}\n")
                except OSError as error:
                    raise DirectoryNotWritable(
                        self._directory, error.strerror
                    ) from error
                if lock is not None:
                    self._held[number] = lock
        return len(self._held)


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

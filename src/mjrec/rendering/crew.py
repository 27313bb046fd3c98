# SPDX-License-Identifier: Apache-2.0
"""The workers of one process, as many as its share of the machine allows."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from .cpu_slots import CpuSlots, check_workers
from .workers import DrawingWorkers


class Crew:
    """Hands out drawing workers.

    Args:
        directory: the monitor directory.
        workers: how many; None is one for each CPU of the directory that is free.
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
        self._workers: DrawingWorkers | None = None
        self._count = 0

    def at_work(self) -> DrawingWorkers:
        """Return the workers, to be used until the next call of any method.

        Waits for a free CPU, unless a number of workers was asked for.
        """
        count = self._fixed or self._slots.take(self._slots.total)
        if self._workers is None or count != self._count:
            self.dismiss()
            self._workers, self._count = DrawingWorkers(count), count
        return self._workers

    def rest(self) -> None:
        """Give the CPUs back: there is nothing to draw. The workers stay."""
        self._slots.give_back()

    def dismiss(self) -> None:
        """End the workers; the next use starts others."""
        if self._workers is not None:
            self._workers.close()
            self._workers = None

    def close(self) -> None:
        """End the workers at once and give the CPUs back. Idempotent."""
        self.dismiss()
        self.rest()

# SPDX-License-Identifier: Apache-2.0
"""An engine that runs jobs on this machine, and what all engines have in common."""

from __future__ import annotations

import functools
import math
import queue
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Any

from ..errors import ClosedError, InvalidArgument
from ..gl.devices import visible_gpus
from ..machine import usable_cpus
from . import worker


@dataclass(frozen=True, kw_only=True)
class GpuShare:
    """Each worker's share of the GPUs.

    Attributes:
        each: number of GPUs per worker, which may be a fraction: with 0.25, four
            workers share a GPU. 0 means no GPU.
        required: whether a worker that renders in software is an error instead of a
            warning.

    Raises:
        InvalidArgument: `each` is not a number, is negative, or is more than 1 and not
            whole; or a GPU is required but `each` is 0.
    """

    each: float = 0.0
    required: bool = False

    def __post_init__(self) -> None:
        number = isinstance(self.each, int | float) and not isinstance(self.each, bool)
        if not (number and math.isfinite(self.each) and self.each >= 0):
            raise InvalidArgument(
                "gpus must be the number of GPUs per worker, such as 1, or 0.25 if "
                f"four share one, but it is {self.each!r}."
            )
        if self.each > 1 and self.each != int(self.each):
            raise InvalidArgument(
                "A worker gets part of one GPU or several whole GPUs, so gpus cannot "
                f"be {self.each:g}."
            )
        if self.required and not self.each:
            raise InvalidArgument(
                "A GPU is required (require_gpu, --require-gpu). Give each worker a "
                "share of a GPU, such as gpus=0.25 (--gpus 0.25)."
            )

    @property
    def asked_for(self) -> bool:
        """Whether workers get GPUs."""
        return self.each > 0

    @property
    def sharing(self) -> int:
        """Number of workers that share a GPU; 1 if no GPUs were requested."""
        return max(1, math.floor(1 / self.each + 1e-9)) if self.asked_for else 1

    def of(self, seat: int, gpus: Sequence[str]) -> str | None:
        """Return the GPUs for a worker, in the format of `CUDA_VISIBLE_DEVICES`.

        If there are more workers than shares, the assignment wraps around to the first
        GPU.

        Args:
            seat: the worker's number, from 0.
            gpus: the available GPUs, as in `CUDA_VISIBLE_DEVICES`.

        Returns:
            The GPUs, or None if there are none or none were requested.
        """
        if not (gpus and self.asked_for):
            return None
        count = max(1, int(self.each))
        first = seat // self.sharing * count
        return ",".join(
            dict.fromkeys(gpus[(first + n) % len(gpus)] for n in range(count))
        )


def check_worker_count(count: int | None, name: str = "workers") -> int | None:
    """Check that a number of workers is a whole number of at least 1, or None.

    Args:
        count: the number.
        name: the argument's name, for the error message.

    Returns:
        `count`, unchanged.

    Raises:
        InvalidArgument: `count` is anything else.
    """
    whole = isinstance(count, int) and not isinstance(count, bool)
    if count is not None and not (whole and count >= 1):
        raise InvalidArgument(
            f"{name} must be a whole number of at least 1, not {count!r}."
        )
    return count


class LocalEngine(Executor):
    """An engine that runs jobs on this machine, with one thread and child per worker.

    Args:
        workers: maximum number of workers. None means one per usable CPU.
        gpus: number of GPUs for each worker, which may be a fraction: with 0.25, four
            workers share a GPU. Workers share the GPUs in `CUDA_VISIBLE_DEVICES`, or
            all of the machine's GPUs if that variable is not set.
        require_gpu: whether a worker that was given a GPU but renders in software is an
            error instead of a warning.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1, or `gpus` is not
            a valid share.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> None:
        self.workers = check_worker_count(workers) or usable_cpus()
        self.share = GpuShare(each=gpus, required=require_gpu)
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        self._threads = 0
        # This ends the threads of an engine that is garbage-collected.
        self._end = weakref.finalize(self, self._calls.put, None)

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        return f"LocalEngine(workers={self.workers}{gpus})"

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Call `fn` on one of the threads; see `concurrent.futures.Executor`.

        Raises:
            ClosedError: the engine was shut down.
        """
        if not self._end.alive:
            raise ClosedError("The engine was shut down.")
        future: Future[Any] = Future()
        self._calls.put((future, functools.partial(fn, *args, **kwargs)))
        if self._threads < self.workers:
            # Daemon threads, so that they do not delay interpreter exit. They refer
            # only to the queue, so they do not keep the engine alive.
            threading.Thread(
                target=_work,
                args=[self._calls, self.share, self._threads],
                name=f"mjrec-worker-{self._threads}",
                daemon=True,
            ).start()
            self._threads += 1
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more calls and let the threads end. Idempotent."""
        del wait, cancel_futures
        self._end()


_Call = tuple[Future[Any], Callable[[], Any]]


def _work(calls: queue.SimpleQueue[_Call | None], share: GpuShare, number: int) -> None:
    if share.asked_for:
        worker.seat.gpus = share.of(number, visible_gpus())
    while (call := calls.get()) is not None:
        future, do = call
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(do())
            except BaseException as error:
                future.set_exception(error)
        # Do not keep references to this call while waiting for the next one.
        del call, future, do
    # Pass the end marker on to the other threads.
    calls.put(None)

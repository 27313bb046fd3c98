# SPDX-License-Identifier: Apache-2.0
"""An engine that runs jobs in processes on this machine."""

from __future__ import annotations

import functools
import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from ..errors import ClosedError
from ..gl.devices import visible_gpus
from ..machine import usable_cpus
from . import worker
from .gpu_shares import GpuShare, check_worker_count


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

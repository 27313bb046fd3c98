# SPDX-License-Identifier: Apache-2.0
"""Jobs in processes of this machine."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from ..errors import ClosedError
from ..gl.devices import visible_gpus
from ..machine import usable_cpus
from . import worker
from .gpu_shares import GpuShare, check_worker_count


class LocalEngine(Executor):
    """Runs jobs in processes of this machine: threads, each with a child at work.

    Args:
        workers: how many at most; None is one for each CPU that may be used.
        gpus: how much of a GPU each worker gets: with 0.25 four share one. They are
            given those that `CUDA_VISIBLE_DEVICES` names, else all of the machine.
        require_gpu: a worker that renders in software though it was given a GPU is an
            error, and not only a warning.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1, or `gpus` is no
            share of GPUs.
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
        self.require_gpu = self.share.required if self.share.asked_for else None
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        self._threads = 0
        self._idle = threading.Semaphore(0)
        self._is_shut_down = False

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        return f"LocalEngine(workers={self.workers}{gpus})"

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Call `fn` on one of the threads; see `concurrent.futures.Executor`.

        Raises:
            ClosedError: it was shut down.
        """
        if self._is_shut_down:
            raise ClosedError("The engine was shut down.")
        call = _Call(fn, args, kwargs)
        self._calls.put(call)
        if not self._idle.acquire(blocking=False) and self._threads < self.workers:
            # Daemons: a run that is forgotten must not hold up the interpreter's end.
            threading.Thread(
                target=self._work,
                args=[self._threads],
                name=f"mjrec-worker-{self._threads}",
                daemon=True,
            ).start()
            self._threads += 1
        return call.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more calls, and let the threads end. Idempotent."""
        del wait, cancel_futures
        if not self._is_shut_down:
            self._is_shut_down = True
            for _ in range(self._threads):
                self._calls.put(None)

    def _work(self, number: int) -> None:
        if self.share.asked_for:
            worker.seat.gpus = self.share.of(number, visible_gpus())
        while (call := self._calls.get()) is not None:
            call.do()
            # So that nothing of it lives on until the next one.
            del call
            self._idle.release()


class _Call:
    """A call, and its future."""

    def __init__(self, fn: Callable[..., Any], args: Any, kwargs: Any) -> None:
        self.future: Future[Any] = Future()
        self._fn, self._args, self._kwargs = fn, args, kwargs

    def do(self) -> None:
        if not self.future.set_running_or_notify_cancel():
            return
        try:
            self.future.set_result(self._fn(*self._args, **self._kwargs))
        except BaseException as error:
            self.future.set_exception(error)

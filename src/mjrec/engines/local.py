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

_SECONDS_IDLE = 5.0


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
        # The numbers of the threads, and how many of them wait for a call.
        self._seats: set[int] = set()
        self._idle = 0
        self._one_at_a_time = threading.Lock()
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
        with self._one_at_a_time:
            self._calls.put(call)
            if self._idle:
                self._idle -= 1
            elif len(self._seats) < self.workers:
                seat = min({*range(self.workers)} - self._seats)
                self._seats.add(seat)
                # Daemons: a forgotten run must not hold up the interpreter's end.
                threading.Thread(
                    target=self._work,
                    args=[seat],
                    name=f"mjrec-worker-{seat}",
                    daemon=True,
                ).start()
        return call.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more calls, and let the threads end. Idempotent."""
        del wait, cancel_futures
        self._is_shut_down = True
        for _ in range(self.workers):
            self._calls.put(None)

    def _work(self, seat: int) -> None:
        if self.share.asked_for:
            worker.seat.gpus = self.share.of(seat, visible_gpus())
        while True:
            try:
                call = self._calls.get(timeout=_SECONDS_IDLE)
            except queue.Empty:
                with self._one_at_a_time:
                    if self._idle and self._calls.empty():
                        # So that an engine is not kept by threads that wait for it.
                        self._idle -= 1
                        self._seats.remove(seat)
                        return
                continue
            if call is None:
                return
            call.do()
            # So that nothing of it lives on until the next one.
            del call
            with self._one_at_a_time:
                self._idle += 1


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

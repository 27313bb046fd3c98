# SPDX-License-Identifier: Apache-2.0
"""Work in processes of this machine."""

from __future__ import annotations

import itertools
import logging
import os
import selectors
import time
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..child_python import environment_of_child, unpacked
from ..errors import Error, InvalidArgument
from ..gl.devices import CUDA_VISIBLE_DEVICES, visible_gpus
from ..machine import usable_cpus
from .base_run import BaseRun
from .gpu_shares import GpuShare
from .home_log import HomeLog
from .job_book import Task, as_json
from .local_process import WorkerProcess
from .local_worker import SECONDS_TO_CLOSE
from .work import Work

logger = logging.getLogger(__name__)

_ENDS_AT_ONCE = 2


class LocalEngine:
    """Runs work in processes of this machine.

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

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        return f"LocalEngine(workers={self.workers}{gpus})"

    def begin(self, work: Work) -> LocalRun:
        """Begin a run. Workers are started when there are jobs.

        Raises:
            InvalidArgument: the settings are no JSON.
            Error: the system grants no memory for the payload.
        """
        gpus = visible_gpus() if self.share.asked_for else []
        return LocalRun(work, self.workers, share=self.share, gpus=gpus)


class LocalRun(BaseRun):
    """Work that has been begun.

    Workers start, take jobs and are heard while `results` is iterated over. Each is
    given one job at a time, and stays for the next until the end of the run. What they
    print is passed on to this process's standard error.

    A job whose worker dies is put behind the others and begun again, three times in
    all; then its failure says what the last worker died of.

    Args:
        work: what the workers do.
        workers: how many at most.
        share: what each gets of GPUs; None is nothing.
        gpus: those that there are, as `CUDA_VISIBLE_DEVICES` names them.
        directory: their working directory; this process's, if None.

    Raises:
        InvalidArgument: the settings are no JSON.
        Error: the system grants no memory for the payload.
    """

    def __init__(
        self,
        work: Work,
        workers: int,
        *,
        share: GpuShare | None = None,
        gpus: Sequence[str] = (),
        directory: Path | None = None,
    ) -> None:
        super().__init__()
        self._most = workers
        self._share = share or GpuShare()
        self._gpus = gpus
        self._directory = directory
        self._environ = environment_of_child({**os.environ, **work.environ})
        self._work = _written(work, self._share)
        self._forget_work = weakref.finalize(self, os.close, self._work)
        self._selector = selectors.DefaultSelector()
        self._workers: list[_Worker] = []
        self._log = HomeLog()
        self._ends_at_once = 0

    @property
    def workers(self) -> int:
        """How many there are at most."""
        return self._most

    def _end(self) -> None:
        try:
            self._let_workers_end()
        finally:
            # Also where Ctrl-C has cut the waiting short.
            for worker in list(self._workers):
                self._dismiss(worker)
            self._selector.close()
            self._forget_work()

    def _turn(self, seconds: float | None) -> None:
        self._hand_out()
        self._listen(seconds)
        self._hand_out()

    def _hand_out(self) -> None:
        """Give jobs to whoever is idle; start no more workers than there are jobs."""
        idle = [worker for worker in self._workers if worker.is_idle]
        while self._book.waiting and idle:
            idle.pop().begin(self._book.take())
        starting = sum(not worker.is_ready for worker in self._workers)
        while self._book.waiting > starting and len(self._workers) < self._most:
            self._start()
            starting += 1

    def _start(self) -> None:
        taken = {worker.seat for worker in self._workers}
        seat = next(n for n in itertools.count() if n not in taken)
        environ = self._environ
        if (gpu := self._share.of(seat, self._gpus)) is not None:
            environ = {**environ, CUDA_VISIBLE_DEVICES: gpu}
        process = WorkerProcess(self._work, environ, directory=self._directory)
        worker = _Worker(process, seat)
        self._workers.append(worker)
        for end in (worker.process.answers, worker.process.words):
            self._selector.register(end, selectors.EVENT_READ, worker)

    def _listen(self, seconds: float | None) -> None:
        """Take in what the workers say, waiting so long for it; for ever if None."""
        for key, _ in self._selector.select(seconds):
            worker: _Worker = key.data
            # Another event may have ended it.
            if worker not in self._workers:
                continue
            if key.fileobj is worker.process.answers:
                self._take_in(worker, worker.process.receive())
            elif not worker.process.listen():
                self._selector.unregister(key.fileobj)

    def _take_in(self, worker: _Worker, answers: list[dict[str, Any]] | None) -> None:
        if answers is None:
            self._replace(worker)
            return
        for answer in answers:
            if "log" in answer:
                self._log.tell([answer["log"]])
            elif "ready" in answer:
                worker.is_ready = True
                self._ends_at_once = 0
            elif "error" in answer:
                self._dismiss(worker)
                raise unpacked(answer["error"])
            else:
                self._book.finish(
                    worker.end_task(),
                    value=answer.get("value"),
                    failure=answer.get("failure"),
                )

    def _replace(self, worker: _Worker) -> None:
        """See what is to be done about one that has ended."""
        how = worker.process.last_words()
        self._dismiss(worker)
        if self._cancelled:
            return
        if not worker.is_ready:
            self._ends_at_once += 1
            if self._ends_at_once >= _ENDS_AT_ONCE:
                raise Error(f"No worker can begin. The last one {how}")
            logger.warning("A worker could not begin, and is replaced. It %s", how)
        elif worker.task is not None:
            self._book.begin_again(worker.task, how)

    def _let_workers_end(self) -> None:
        for worker in self._workers:
            worker.process.ask_to_end()
        deadline = time.monotonic() + SECONDS_TO_CLOSE
        while self._workers and (rest := deadline - time.monotonic()) > 0:
            # What they say is heard: who cannot print does not come to its end.
            self._listen(rest)
        if self._workers:
            logger.warning(
                "%d workers have not ended %g seconds after they were told to, and "
                "are killed.",
                len(self._workers),
                SECONDS_TO_CLOSE,
            )

    def _dismiss(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        for end in (worker.process.answers, worker.process.words):
            # That of the words is let go of when it ends.
            if end in self._selector.get_map():
                self._selector.unregister(end)
        worker.process.end()


@dataclass(eq=False)
class _Worker:
    """A process, and what it is at."""

    process: WorkerProcess
    seat: int
    is_ready: bool = False
    task: Task | None = None

    @property
    def is_idle(self) -> bool:
        return self.is_ready and self.task is None

    def begin(self, task: Task) -> None:
        self.task = task
        # Its last words shall be about this job.
        self.process.listen()
        self.process.forget_words()
        self.process.send(task.line)

    def end_task(self) -> Task:
        task, self.task = self.task, None
        assert task is not None
        return task


def check_worker_count(workers: int | None) -> int | None:
    """Return `workers` if it is a number of workers, or None.

    Raises:
        InvalidArgument: it is something else.
    """
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if workers is not None and not (whole and workers >= 1):
        raise InvalidArgument(
            f"workers must be a whole number of at least 1, got {workers!r}."
        )
    return workers


def _written(work: Work, share: GpuShare) -> int:
    """Write work for all workers, once; return the file's descriptor."""
    payload = work.payload
    facts = {
        "entry": work.entry,
        "settings": dict(work.settings),
        "gpu": {"required": share.required} if share.asked_for else None,
        "payload": None if payload is None else len(payload),
    }
    line = as_json(facts, what="The settings of the work")
    try:
        # It has no name: nothing has to be removed, and nobody else can read it.
        descriptor = os.memfd_create("mjrec-work")
        try:
            for part in (line + b"\n", payload or b""):
                _write_whole(descriptor, part)
        except BaseException:
            os.close(descriptor)
            raise
    except OSError as error:
        raise Error(f"No memory for what the workers are given: {error}.") from error
    return descriptor


def _write_whole(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]

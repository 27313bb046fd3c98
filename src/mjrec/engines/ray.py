# SPDX-License-Identifier: Apache-2.0
"""Work in actors of a Ray cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import time
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mjrec

from ..child_python import said_in
from ..errors import Error, GLError
from ..signals import received
from .base_run import BaseRun
from .gpu_shares import GpuShare
from .home_log import HomeLog
from .hosting import HostedWork, take_home
from .job_book import Task
from .local import check_worker_count
from .local_worker import SECONDS_TO_CLOSE
from .ray_connection import ClusterWatch, RayConnection, import_ray
from .ray_worker import METHODS_AT_ONCE, RayWorker
from .work import JobOutcome, Work

logger = logging.getLogger(__name__)

_ENDS_AT_ONCE = 2
_NO_MJREC = "No module named 'mjrec"
_LONGEST_WAIT_S = 1.0
# Ray ends this process after 60 seconds without its cluster, and says nothing of ours.
_SECONDS_OF_SILENCE = 30.0
_SECONDS_WITHOUT_WORKERS = 30.0
# Workers end their own processes after `SECONDS_TO_CLOSE`, and then they say so.
_SECONDS_TO_SAY_SO = 5.0


class RayEngine:
    """Runs work on a Ray cluster.

    Each worker is an actor, which has a CPU, and does its jobs in a process beside it.

    Args:
        workers: how many at most; None is as many as the cluster has CPUs, and parts of
            GPUs where such are asked for, also when it grows. A cluster that starts
            its machines when they are needed has to be told a number.
        address: of the cluster; None is the one that `RAY_ADDRESS` names, else a Ray
            that is started on this machine for each run. Where this process is
            connected to Ray already, that is used, and left as it is.
        gpus: how much of a GPU each worker gets: with 0.25 four share one.
        require_gpu: a worker that renders in software though it was given a GPU is an
            error, and not only a warning.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1, or `gpus` is no
            share of GPUs.
        MissingDependency: Ray is not installed.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        address: str | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> None:
        self.workers = check_worker_count(workers)
        self.address = address
        self.share = GpuShare(each=gpus, required=require_gpu)
        import_ray()

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        address = f", address={self.address!r}" if self.address else ""
        return f"RayEngine(workers={self.workers}{address}{gpus})"

    def begin(self, work: Work) -> RayRun:
        """Begin a run. Workers are started when there are jobs.

        Raises:
            InvalidArgument: the settings are no JSON.
            GLError: a GPU is required, and the Ray that is started has none.
            Error: there is no such cluster, or no Ray can be started.
        """
        # Before anything is started.
        HostedWork.of(work, self.share).to_json()
        connection = RayConnection(
            self.address, cpus=self.workers, payload_size=len(work.payload or b"")
        )
        try:
            share = self._to_be_had(connection)
            return RayRun(
                HostedWork.of(work, share).to_json(),
                work.payload,
                connection,
                workers=self.workers,
                share=share,
            )
        except BaseException:
            connection.leave()
            raise

    def _to_be_had(self, connection: RayConnection) -> GpuShare:
        """Return what workers can be given; nothing where they would wait for ever.

        Raises:
            GLError: there is no GPU, and one is required.
        """
        if not (self.share.asked_for and connection.lacks_gpus()):
            return self.share
        lack = "Workers are to get GPUs, and Ray finds none on this machine."
        if self.share.required:
            raise GLError(f"{lack} `nvidia-smi -L` lists those that there are.")
        logger.warning("%s They draw in software.", lack)
        return GpuShare()


class RayRun(BaseRun):
    """Work that has been begun on a Ray cluster.

    Workers start, take jobs and are heard while `results` is iterated over. Each is
    given one job at a time, and stays for the next until the end of the run. What they
    print comes to this process by way of Ray.

    A job whose worker dies is put behind the others and begun again, three times in
    all; one whose machine goes away is begun again as often as that happens.

    Args:
        hosted: what the workers do, as JSON.
        payload: of it.
        connection: to the cluster, which is left at the end.
        workers: how many at most; None is what the cluster has room for.
        share: what each gets of GPUs.
    """

    def __init__(
        self,
        hosted: bytes,
        payload: bytes | None,
        connection: RayConnection,
        *,
        workers: int | None,
        share: GpuShare,
    ) -> None:
        super().__init__()
        self._ray = import_ray()
        self._asked_for = workers
        self._share = share
        self._watch = ClusterWatch()
        self._hosted = hosted
        # Into the object store, from where each worker gets it once.
        self._payload = None if payload is None else self._ray.put(payload)
        self._kind = self._ray.remote(
            num_cpus=1,
            num_gpus=share.each,
            max_concurrency=METHODS_AT_ONCE,
            # Tries are counted here.
            max_restarts=0,
            max_task_retries=0,
        )(RayWorker)
        self._seats: list[_Seat] = []
        self._log = HomeLog()
        self._ends_at_once = 0
        self._last_had_workers = time.monotonic()
        self._has_told_of_waiting = False
        self._leave = weakref.finalize(
            self, _leave, self._seats, self._watch, connection, os.getpid()
        )

    @property
    def workers(self) -> int:
        """How many there are at most: as asked for, or as there is room for now."""
        return self._asked_for or max(1, self._watch.room_for(self._share))

    def results(
        self, *, patience_s: float | None = None
    ) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they come, until none is outstanding or all is cancelled.

        Where the cluster has no room for any worker, it is waited for, and a warning
        says so.

        Args:
            patience_s: None is yielded whenever no outcome has come for so long; never,
                if it is None.

        Raises:
            InvalidArgument: `patience_s` is no positive number.
            ClosedError: the run is cancelled, or another process's.
            Error: the cluster is gone, no worker can begin, or what makes the handler
                raised. What it raised, if that is one of ours.
        """
        self._last_had_workers = time.monotonic()
        return super().results(patience_s=patience_s)

    def _end(self) -> None:
        try:
            self._let_workers_end()
        finally:
            # Also where Ctrl-C has cut the waiting short.
            self._leave()

    def _turn(self, seconds: float | None) -> None:
        try:
            self._hand_out()
            self._listen(seconds)
            self._hand_out()
        except SystemExit as error:
            # Of what a signal's handler raises inside Ray, Ray makes one of its own.
            raise received() or error from None

    def _hand_out(self) -> None:
        """Give jobs to whoever is idle; start no more workers than there are jobs."""
        idle = [seat for seat in self._seats if seat.is_idle]
        while self._book.waiting and idle:
            idle.pop().begin(self._book.take())
        starting = sum(not seat.is_ready for seat in self._seats)
        most = self.workers
        while self._book.waiting > starting and len(self._seats) < most:
            self._start()
            starting += 1

    def _start(self) -> None:
        actor = self._kind.remote(self._hosted, self._payload)
        gone = self._watch.dead_nodes
        self._seats.append(_Seat(actor, actor.hello.remote(), gone))

    def _listen(self, seconds: float | None) -> None:
        """Take in what a worker says, waiting for it, if need be, for a moment."""
        waited_for = {seat.answer: seat for seat in self._seats if not seat.is_idle}
        moment = _LONGEST_WAIT_S if seconds is None else min(seconds, _LONGEST_WAIT_S)
        answers, _ = self._ray.wait(list(waited_for), timeout=moment)
        for answer in answers:
            self._take_in(waited_for[answer])
        self._look_at_cluster()

    def _take_in(self, seat: _Seat) -> None:
        try:
            said = self._ray.get(seat.answer)
        except self._ray.exceptions.RayError as error:
            self._replace(seat, error)
            return
        if seat.task is None:
            self._welcome(seat, said_in(said))
        elif said is None:
            self._begin_elsewhere(seat, "is told to end")
        else:
            task = seat.end_task()
            if "error" in said_in(said):
                self._dismiss(seat)
            take_home(said, task, self._book, self._log)

    def _welcome(self, seat: _Seat, said: dict[str, Any]) -> None:
        if said["version"] != mjrec.__version__:
            raise Error(
                f"mjrec is {mjrec.__version__} here and {said['version']} on "
                f"{said['machine']}, where Ray has started a worker: install the same "
                "on all machines of the cluster."
            )
        seat.node, seat.machine = said["node"], said["machine"]
        seat.answer = None
        self._ends_at_once = 0
        self._has_told_of_waiting = False

    def _replace(self, seat: _Seat, error: Exception) -> None:
        """See what is to be done about a worker that is gone."""
        # Where its class cannot be imported, Ray does not say so otherwise.
        if getattr(error, "actor_init_failed", False) or _NO_MJREC in str(error):
            self._dismiss(seat)
            raise Error(_why_none_can_begin(error)) from error
        if self._is_nobodys_fault(seat, error):
            self._begin_elsewhere(seat, "has gone")
            return
        task, how = seat.task, _how_it_ended(error)
        self._dismiss(seat)
        if task is not None:
            self._book.begin_again(task, how)
            return
        self._ends_at_once += 1
        if self._ends_at_once >= _ENDS_AT_ONCE:
            raise Error(f"No worker can begin. The last one {how}")
        logger.warning("A worker could not begin, and is replaced. It %s", how)

    def _is_nobodys_fault(self, seat: _Seat, error: Exception) -> bool:
        """Return whether a worker is gone with its machine."""
        # For seconds nobody knows more than that it does not answer; that its process
        # has died would be known at once.
        if isinstance(error, self._ray.exceptions.ActorUnavailableError):
            return True
        if getattr(error, "preempted", False):
            return True
        self._watch.look()
        dead = self._watch.dead_nodes
        return seat.node in dead if seat.node else bool(dead - seat.gone_before)

    def _begin_elsewhere(self, seat: _Seat, what: str) -> None:
        task, machine = seat.task, seat.machine
        self._dismiss(seat)
        if task is None:
            return
        logger.warning(
            "The worker on %s %s: the job %s is begun again.", machine, what, task.key
        )
        self._book.put_back(task)

    def _look_at_cluster(self) -> None:
        if self._watch.silent_s > _SECONDS_OF_SILENCE:
            raise Error(
                "The Ray cluster does not answer any more. What is finished is kept: "
                "go on with --resume (resume=True) when the cluster is there again."
            )
        now = time.monotonic()
        if any(seat.is_ready for seat in self._seats):
            self._last_had_workers = now
        waited = now - self._last_had_workers
        if waited > _SECONDS_WITHOUT_WORKERS and not self._has_told_of_waiting:
            self._has_told_of_waiting = True
            logger.warning(
                "The Ray cluster has had no room for a worker for %.0f s, and is "
                "waited for. Each needs %s; in all there are %g CPUs and %g GPUs.",
                waited,
                _needs(self._share),
                self._watch.total("CPU"),
                self._watch.total("GPU"),
            )

    def _let_workers_end(self) -> None:
        if self._watch.silent_s > _SECONDS_OF_SILENCE:
            return
        ends = [seat.actor.end.remote() for seat in self._seats if seat.is_ready]
        if not ends:
            return
        _, left = self._ray.wait(
            ends,
            num_returns=len(ends),
            timeout=SECONDS_TO_CLOSE + _SECONDS_TO_SAY_SO,
        )
        if left:
            logger.warning(
                "%d workers have not ended after they were told to, and are killed.",
                len(left),
            )

    def _dismiss(self, seat: _Seat) -> None:
        self._seats.remove(seat)
        seat.kill()


@dataclass(eq=False)
class _Seat:
    """A worker, and what it is at.

    Attributes:
        actor: the worker.
        answer: reference of what it is to say next; None if that is nothing.
        gone_before: the nodes that had gone when it was started.
        node: its node's id; empty until it has begun.
        machine: its machine's name.
        task: what it does.
    """

    actor: Any
    answer: Any
    gone_before: frozenset[str]
    node: str = ""
    machine: str = ""
    task: Task | None = None

    @property
    def is_ready(self) -> bool:
        return bool(self.node)

    @property
    def is_idle(self) -> bool:
        return self.is_ready and self.task is None

    def begin(self, task: Task) -> None:
        self.task = task
        self.answer = self.actor.do.remote(task.line)

    def end_task(self) -> Task:
        task, self.task = self.task, None
        assert task is not None
        return task

    def kill(self) -> None:
        """End it; its process of jobs notices, and closes what it is at."""
        # It may have ended, or the cluster may.
        with contextlib.suppress(Exception):
            import_ray().kill(self.actor)


def _leave(
    seats: list[_Seat], watch: ClusterWatch, connection: RayConnection, owner: int
) -> None:
    # A forked child has copies.
    if os.getpid() != owner:
        return
    watch.stop()
    for seat in seats:
        seat.kill()
    seats.clear()
    connection.leave()


def _needs(share: GpuShare) -> str:
    return f"1 CPU and {share.each:g} GPUs" if share.asked_for else "1 CPU"


def _how_it_ended(error: Exception) -> str:
    """Return what Ray says of it, as a part of a sentence."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"ended, and Ray says: {lines[-1] if lines else type(error).__name__}"


def _why_none_can_begin(error: Exception) -> str:
    told = str(error).strip()
    if _NO_MJREC in told:
        return (
            "Ray's workers have no mjrec: install it on all machines of the cluster, "
            "for the Python that runs Ray there, in the version that is here "
            f"({mjrec.__version__})."
        )
    return f"No worker can begin on the Ray cluster. Ray says: {told}"

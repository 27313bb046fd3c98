# SPDX-License-Identifier: Apache-2.0
"""The jobs of one run in Slurm jobs: submitted, followed, and done there.

In the run's folder, which all machines see::

    slurm/submitted          numbers of the Slurm jobs, one a line
    slurm/outcomes/17.json   what `worker.do_job` returned of job 17
    slurm/logs/              what the Slurm jobs print, and submitit's own files
    slurm/driver             locked while the driver lives
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import math
import shutil
import signal
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic_files import write_text
from ..gl.devices import visible_gpus
from . import worker
from .gpu_shares import GpuShare
from .slurm_cluster import Cluster

logger = logging.getLogger(__name__)

# So that the last jobs of an array end at about the same time.
_ELEMENTS_PER_WORKER = 4
_SECONDS_TO_GATHER = 0.2
_SECONDS_BETWEEN_LOOKS = 0.2
_SECONDS_BETWEEN_QUESTIONS = 10.0
_SECONDS_WITHOUT_START = 60.0
_SECONDS_TO_END = 15.0
_END_OF_LOG = 2000


@dataclass(frozen=True, kw_only=True)
class Element:
    """What one Slurm job does; plain data.

    Attributes:
        folder: `slurm` in the run's folder.
        messages: of the jobs, as `worker.do_job` takes them, by their numbers.
        workers: how many do them at once.
        share: what each worker gets of the Slurm job's GPUs.
    """

    folder: Path
    messages: Mapping[int, Mapping[str, Any]]
    workers: int
    share: GpuShare


class ArrayRun:
    """The jobs of one run.

    A thread submits them as arrays and looks for their outcomes. What a Slurm job that
    is over has left undone has died.

    Args:
        cluster: where Slurm jobs are submitted.
        place: the run's folder.
        most: how many Slurm jobs there are at once.
        workers: how many workers each holds.
        share: what each worker gets of GPUs.
    """

    def __init__(
        self,
        cluster: Cluster,
        place: Path,
        *,
        most: int,
        workers: int,
        share: GpuShare,
    ) -> None:
        self._cluster = cluster
        self._folder = place / "slurm"
        self._most, self._workers, self._share = most, workers, share
        for name in ("outcomes", "logs"):
            (self._folder / name).mkdir(parents=True)
        self._sign_of_life = (self._folder / "driver").open("wb")
        fcntl.flock(self._sign_of_life, fcntl.LOCK_EX)
        _end_earlier_runs(cluster, place)
        self._new: dict[int, Mapping[str, Any]] = {}
        self._futures: dict[int, Future[Any]] = {}
        self._elements: dict[str, set[int]] = {}
        self._count = 0
        self._last_added = self._last_asked = -math.inf
        self._last_progress = time.monotonic()
        self._has_begun = False
        self._one_at_a_time = threading.Lock()
        self._is_over = threading.Event()
        self._thread = threading.Thread(
            target=self._follow, name="mjrec-slurm", daemon=True
        )
        self._thread.start()

    def add(self, message: Mapping[str, Any], future: Future[Any]) -> None:
        """Add a job; those that come at once share an array."""
        with self._one_at_a_time:
            self._new[self._count] = message
            self._futures[self._count] = future
            self._count += 1
            self._last_added = time.monotonic()

    def cancel(self) -> None:
        """End all Slurm jobs, and wait until they have ended. Idempotent."""
        self._is_over.set()
        self._thread.join()
        self._forget_cancelled()
        self._cluster.end([job for job, numbers in self._elements.items() if numbers])
        deadline = time.monotonic() + _SECONDS_TO_END
        while self._elements and time.monotonic() < deadline:
            # Where Slurm does not answer, the deadline ends this.
            states = self._cluster.states(self._elements)
            for job in [job for job, state in states.items() if state.is_over]:
                del self._elements[job]
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        self._sign_of_life.close()

    def _follow(self) -> None:
        try:
            while not self._is_over.wait(_SECONDS_BETWEEN_LOOKS):
                with self._one_at_a_time:
                    self._submit()
                    self._take_outcomes()
                    now = time.monotonic()
                    if now - self._last_asked > self._seconds_between_questions:
                        self._last_asked = now
                        self._ask()
        except Exception as error:
            for future in self._futures.values():
                with contextlib.suppress(Exception):
                    future.set_exception(error)

    @property
    def _seconds_between_questions(self) -> float:
        is_local = self._cluster.name == "local"
        return _SECONDS_BETWEEN_LOOKS if is_local else _SECONDS_BETWEEN_QUESTIONS

    def _submit(self) -> None:
        if not self._new or time.monotonic() - self._last_added < _SECONDS_TO_GATHER:
            return
        free = self._most - len(self._elements)
        if free <= 0:
            return
        self._forget_cancelled()
        # With nothing running the cluster keeps the limit itself, array by array.
        most = free if self._elements else self._most * _ELEMENTS_PER_WORKER
        numbers = list(self._new)
        count = min(len(numbers), most)
        if not count:
            return
        shares = [numbers[first::count] for first in range(count)]
        elements = [
            Element(
                folder=self._folder,
                messages={number: self._new[number] for number in share},
                workers=self._workers,
                share=self._share,
            )
            for share in shares
        ]
        jobs = self._cluster.submit(
            ArrayElement(), elements, logs=self._folder / "logs"
        )
        self._elements.update(
            (job, set(share)) for job, share in zip(jobs, shares, strict=True)
        )
        with (self._folder / "submitted").open("a") as file:
            file.writelines(f"{job}\n" for job in jobs)
        self._new.clear()

    def _take_outcomes(self) -> None:
        for path in (self._folder / "outcomes").glob("*.json"):
            future = self._futures.pop(int(path.stem), None)
            if future is not None:
                self._has_begun = True
                self._last_progress = time.monotonic()
                _resolve(future, json.loads(path.read_bytes()))
        for numbers in self._elements.values():
            numbers.intersection_update(self._futures)

    def _ask(self) -> None:
        """See what has become of Slurm jobs."""
        states = self._cluster.states(self._elements)
        over = {job: state for job, state in states.items() if state.is_over}
        if over:
            # What they have done before their end.
            self._take_outcomes()
        for job, state in over.items():
            for number in self._elements.pop(job):
                how = (
                    f"was in the Slurm job {job}, which ended ({state.name}). The end "
                    f"of what that said: {self._end_of_log(job)}"
                )
                died = {"died": how, "begun": self._has_begun}
                _resolve(self._futures.pop(number), died)
        waited = time.monotonic() - self._last_progress
        if states and waited > _SECONDS_WITHOUT_START:
            reasons = sorted({each.reason for each in states.values() if each.reason})
            if all(each.name == "PENDING" for each in states.values()):
                self._last_progress = time.monotonic()
                logger.warning(
                    "%d Slurm jobs have waited for %.0f s. Slurm's reason: %s.",
                    len(states),
                    waited,
                    ", ".join(reasons) or "none",
                )

    def _forget_cancelled(self) -> None:
        for number in [n for n, each in self._futures.items() if each.cancelled()]:
            del self._futures[number]
            self._new.pop(number, None)

    def _end_of_log(self, job: str) -> str:
        said = b""
        for path in (self._folder / "logs").glob(f"{job}_*log.err"):
            with contextlib.suppress(OSError):
                said = path.read_bytes()[-_END_OF_LOG:]
        return said.decode(errors="replace").strip() or "(nothing)"


class ArrayElement:
    """What submitit runs in a Slurm job, and puts back into Slurm's queue."""

    def __call__(self, element: Element) -> None:
        """Do the element's jobs, as far as they are not done."""
        is_ending = threading.Event()

        def end(*_: object) -> None:
            is_ending.set()
            worker.ask_all_to_end()

        # submitit takes no notice of it.
        signal.signal(signal.SIGTERM, end)
        seats = iter(range(element.workers))
        gpus = visible_gpus() if element.share.asked_for else []

        def sit() -> None:
            worker.seat.gpus = element.share.of(next(seats), gpus)

        def do(number: int) -> None:
            path = element.folder / "outcomes" / f"{number}.json"
            if path.exists() or is_ending.is_set():
                return
            said = worker.do_job(element.messages[number])
            # One that was told to end is no job's fault.
            if not ("died" in said and is_ending.is_set()):
                write_text(path, json.dumps(said))

        with ThreadPoolExecutor(element.workers, initializer=sit) as pool:
            for _ in pool.map(do, element.messages):
                pass
        for message in element.messages.values():
            worker.end_idle_children(message["work"]["place"])

    def checkpoint(self, element: Element) -> Any:
        """Return what goes on after the job's time limit, or its preemption."""
        # Only on the cluster.
        import submitit

        worker.ask_all_to_end()
        return submitit.helpers.DelayedSubmission(self, element)


def _resolve(future: Future[Any], said: Any) -> None:
    if future.set_running_or_notify_cancel():
        future.set_result(said)


def _end_earlier_runs(cluster: Cluster, place: Path) -> None:
    """End what a killed driver has left in the same shared directory."""
    for folder in place.parent.glob("*/slurm"):
        if folder.parent == place or _has_driver(folder):
            continue
        logger.info("The run in %s has no driver, and is ended.", folder.parent)
        with contextlib.suppress(OSError):
            cluster.end((folder / "submitted").read_text().split())
        shutil.rmtree(folder.parent, ignore_errors=True)


def _has_driver(folder: Path) -> bool:
    """Tell whether the driver lives whose Slurm jobs a folder is of."""
    try:
        with (folder / "driver").open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False

# SPDX-License-Identifier: Apache-2.0
"""Work in jobs of a Slurm cluster.

A Slurm job is not a piece of work but a *host* of workers: it waits in Slurm's queue
once, then does one job of the run after the other. Jobs and outcomes travel as files,
`job_folder` says how; what runs in a Slurm job is `job_folder_host`.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

from ..child_python import said_in
from ..errors import InvalidArgument, UnknownName
from ..machine import usable_cpus
from .base_run import BaseRun
from .driver_sign import DriverSign
from .gpu_shares import GpuShare
from .home_log import HomeLog
from .hosting import HostedWork, take_home
from .job_book import Task
from .job_folder import JobFolder, Pace, TakenJob
from .job_folder_host import GIVEN_BACK, HAD_MUCH_TIME
from .local import check_worker_count
from .run_place import EarlierRun, RunPlace
from .slurm_hosts import HostEnd, SlurmHosts
from .slurm_jobs import ClusterJobs, JobRequest, check_cluster, cluster_jobs
from .work import Run, Work

logger = logging.getLogger(__name__)

# What a cluster would grant is not known before; four are what nobody minds.
DEFAULT_WORKERS = 4

_SHORTEST_POLL = 0.005
_POLLS_GROW = 1.5
# Hosts find so many jobs each, so that none waits for the driver.
_JOBS_AHEAD = 2


class SlurmEngine:
    """Runs work in jobs of a Slurm cluster.

    Args:
        workers: how many at most, in all Slurm jobs together; None is 4, and one for
            each CPU where `cluster` is `"local"`.
        cluster: None is the Slurm cluster that this machine belongs to; `"local"` is
            this machine, with processes in place of Slurm jobs, to try it out.
        gpus: how much of a GPU each worker gets: with 0.25 four share one.
        require_gpu: a worker that renders in software though it was given a GPU is an
            error, and not only a warning.
        cpus_per_worker: how many CPUs each worker gets.
        workers_per_job: how many workers a Slurm job holds, on one machine; None is as
            many as share a GPU, else one.
        partition: in which Slurm jobs run; None is the cluster's default, for this and
            what follows.
        account: which they are charged to.
        qos: their quality of service.
        constraint: features that their nodes have.
        time_min: their time limit in minutes. It ends no work: another takes the
            place of one whose time is over. The longest job has to fit.
        notice_s: so many seconds before its time limit a Slurm job takes no more
            jobs; what it is at then can still be done. None is 120, or a quarter of
            a short limit.
        mem_gb: memory of each worker, in gigabytes.
        setup: lines of shell that run in a Slurm job before anything else.
        sbatch: any other options of `sbatch`, by name, without their dashes.

    Raises:
        InvalidArgument: one of them cannot be.
        MissingDependency: submitit is not installed.
        Error: this machine has no commands of Slurm's.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        cluster: str | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
        cpus_per_worker: int = 1,
        workers_per_job: int | None = None,
        partition: str | None = None,
        account: str | None = None,
        qos: str | None = None,
        constraint: str | None = None,
        time_min: int = 60,
        notice_s: float | None = None,
        mem_gb: float | None = None,
        setup: Sequence[str] = (),
        sbatch: Mapping[str, str | int | bool] | None = None,
    ) -> None:
        given = check_worker_count(workers)
        self.share = GpuShare(each=gpus, required=require_gpu)
        _check_whole("cpus_per_worker", cpus_per_worker)
        _check_whole("time_min", time_min)
        if workers_per_job is not None:
            _check_whole("workers_per_job", workers_per_job)
        if mem_gb is not None and not mem_gb > 0:
            raise InvalidArgument(f"mem_gb is more than 0, got {mem_gb!r}.")
        if notice_s is None:
            notice_s = min(120.0, 60 * time_min / 4)
        if not 0 <= notice_s < 60 * time_min:
            raise InvalidArgument(
                f"notice_s is less than the time limit of {time_min} minutes (time_min)"
                f", in seconds, got {notice_s!r}."
            )
        self.cluster = check_cluster(cluster)
        self.workers = given or (
            usable_cpus() if self.cluster == "local" else DEFAULT_WORKERS
        )
        per_job = min(workers_per_job or _sharing(self.share), self.workers)
        self._request = JobRequest(
            workers=per_job,
            cpus=cpus_per_worker,
            gpus=math.ceil(self.share.each * per_job - 1e-9),
            time_min=time_min,
            notice_s=notice_s,
            memory_gb=None if mem_gb is None else mem_gb * per_job,
            partition=partition,
            account=account,
            qos=qos,
            constraint=constraint,
            setup=tuple(setup),
            sbatch=dict(sbatch or {}),
        )
        self._pace = Pace()

    @classmethod
    def from_texts(
        cls,
        options: Mapping[str, str],
        *,
        workers: int | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> Self:
        """Return an engine from options as the command line has them.

        Args:
            options: parameters of the class by name, as texts; `sbatch.NAME` is an
                option of `sbatch`, and `setup` one line.
            workers: as of the class.
            gpus: likewise.
            require_gpu: likewise.

        Raises:
            UnknownName: there is no such option.
            InvalidArgument: one of them cannot be.
            MissingDependency: submitit is not installed.
            Error: this machine has no commands of Slurm's.
        """
        known: dict[str, Any] = {}
        sbatch: dict[str, str | int | bool] = {}
        for name, text in options.items():
            if name.startswith(_SBATCH):
                sbatch[name.removeprefix(_SBATCH)] = text or True
            elif name in _FROM_TEXT:
                known[name] = _value_of(name, text)
            else:
                raise UnknownName(
                    "option of Slurm's",
                    name,
                    [*_FROM_TEXT, f"{_SBATCH}NAME"],
                    hint=f"Any other option of sbatch is {_SBATCH}NAME=VALUE.",
                )
        return cls(workers, gpus=gpus, require_gpu=require_gpu, sbatch=sbatch, **known)

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        where = ", cluster='local'" if self.cluster == "local" else ""
        return f"SlurmEngine(workers={self.workers}{where}{gpus})"

    def begin(self, work: Work) -> Run:
        """Begin a run. Slurm jobs are submitted when there are jobs.

        What an earlier run with the same shared directory has left behind, because its
        driver was killed, is told to end.

        Raises:
            InvalidArgument: the settings are no JSON, or the work has no shared
                directory.
            DirectoryNotWritable: that directory.
        """
        return SlurmRun(
            work,
            workers=self.workers,
            share=self.share,
            cluster=self.cluster,
            request=self._request,
            pace=self._pace,
        )


class SlurmRun(BaseRun):
    """Work that has been begun.

    Slurm jobs are submitted, and jobs handed out, while `results` is iterated over. One
    that ends is replaced as long as there is work for it. A job whose worker dies is
    begun again in the same Slurm job; one whose Slurm job ends in another, which counts
    as a try where the job itself may be to blame.

    Args:
        work: what the workers do.
        workers: how many at most.
        share: what each gets of GPUs.
        cluster: where Slurm jobs are submitted to.
        request: what each of them is asked for with.
        pace: how often files and the cluster are looked at.

    Raises:
        InvalidArgument: the settings are no JSON, or the work has no shared directory.
        DirectoryNotWritable: that directory.
    """

    def __init__(
        self,
        work: Work,
        *,
        workers: int,
        share: GpuShare,
        cluster: str,
        request: JobRequest,
        pace: Pace,
    ) -> None:
        if work.shared_directory is None:
            raise InvalidArgument(
                "Workers in Slurm jobs need a directory that all machines see, and "
                "this work names none (shared_directory)."
            )
        super().__init__()
        self._most = workers
        self._request = request
        self._pace = pace
        self._place = RunPlace(work.shared_directory)
        self._folder = self._place.make(HostedWork.of(work, share), work.payload)
        self._jobs = cluster_jobs(cluster, self._folder, request, pace)
        self._sign = DriverSign(self._folder, cluster, every_s=pace.beat_s)
        self._earlier = [
            EarlierRun(folder, request, pace) for folder in self._place.others()
        ]
        self._hosts = SlurmHosts(self._folder, self._jobs, pace)
        self._log = HomeLog()
        self._out: dict[int, Task] = {}
        self._numbers = itertools.count(1)
        self._looked = -math.inf
        self._pause = _SHORTEST_POLL
        self._leave = weakref.finalize(
            self, _abandon, self._folder, self._jobs, self._sign, os.getpid()
        )
        self._see_earlier_runs()

    @property
    def workers(self) -> int:
        """How many there are at most."""
        return self._most

    def _end(self) -> None:
        try:
            self._hosts.end_all()
        finally:
            self._leave()
            for run in self._earlier:
                run.tidy_up()
            self._place.tidy_up(keep=self._hosts.logs_to_keep)

    def _turn(self, seconds: float | None) -> None:
        any_came = self._hear()
        now = time.monotonic()
        if now - self._looked >= self._pace.look_s:
            self._looked = now
            self._look()
        self._hand_out()
        if any_came or self._book.has_outcome:
            self._pause = _SHORTEST_POLL
        elif seconds != 0:
            time.sleep(self._pause if seconds is None else min(self._pause, seconds))
            self._pause = min(self._pause * _POLLS_GROW, self._pace.poll_s)

    def _hear(self) -> bool:
        came = False
        for answer in self._folder.answers():
            came = True
            self._take_in(answer.number, answer.host, answer.line)
        return came

    def _take_in(self, number: int, host: str, line: bytes) -> None:
        """Note what a host says of a job, if nobody has done so before."""
        task = self._out.pop(number, None)
        if task is None:
            return
        said = said_in(line)
        if not said:
            self._book.put_back(task)
        elif GIVEN_BACK in said:
            self._log.tell(said.get("log", ()))
            self._take_back(task, said[GIVEN_BACK], is_try=said[HAD_MUCH_TIME])
        else:
            take_home(line, task, self._book, self._log)
            self._hosts.has_done_something(host)

    def _take_back(self, task: Task, why: str, *, is_try: bool) -> None:
        if is_try:
            self._book.begin_again(
                task,
                "was at it for more than half of the time that a Slurm job has, which "
                f"is {self._request.time_min} minutes (time_min): {why}",
            )
        else:
            logger.info("The job %s is done elsewhere: %s.", task.key, why)
            self._book.put_back(task)

    def _look(self) -> None:
        """See what became of Slurm jobs, and do again what died with them."""
        dead = self._hosts.look()
        if dead:
            # What they have said before they died.
            self._hear()
            for job in self._folder.taken():
                if (end := dead.get(job.host)) is not None:
                    self._bury(job, end)
        self._hosts.check()
        self._see_earlier_runs()

    def _bury(self, job: TakenJob, end: HostEnd) -> None:
        self._folder.forget(job)
        task = self._out.pop(job.number, None)
        if task is None:
            return
        if end.is_to_blame:
            self._book.begin_again(task, end.how)
        else:
            logger.info("The job %s is done elsewhere: its host %s", task.key, end.how)
            self._book.put_back(task)

    def _hand_out(self) -> None:
        """Lay down jobs, and see that there are hosts to do them."""
        ahead = self._most * (1 + _JOBS_AHEAD)
        while self._book.waiting and len(self._out) < ahead:
            task, number = self._book.take(), next(self._numbers)
            self._out[number] = task
            self._folder.put(number, task.line)
        left = min(self._most, self._book.waiting + len(self._out))
        self._hosts.want(math.ceil(left / self._request.workers))

    def _see_earlier_runs(self) -> None:
        for run in self._earlier:
            run.look()


def _abandon(
    folder: JobFolder, jobs: ClusterJobs, sign: DriverSign, owner: int
) -> None:
    """Let a run end that nobody waits for."""
    # A forked child's copies; the run is its parent's.
    if os.getpid() != owner:
        return
    sign.stop()
    folder.stop()
    submitted = folder.submitted()
    states = jobs.states(submitted)
    jobs.end([n for n in submitted if n not in states or not states[n].is_over])


def _sharing(share: GpuShare) -> int:
    return max(1, math.floor(1 / share.each + 1e-9)) if share.asked_for else 1


def _check_whole(name: str, value: object) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidArgument(
            f"{name} must be a whole number of at least 1, got {value!r}."
        )


_SBATCH = "sbatch."

_FROM_TEXT: Mapping[str, Callable[[str], Any]] = {
    "cluster": str,
    "cpus_per_worker": int,
    "workers_per_job": int,
    "partition": str,
    "account": str,
    "qos": str,
    "constraint": str,
    "time_min": int,
    "notice_s": float,
    "mem_gb": float,
    "setup": lambda line: (line,),
}


def _value_of(name: str, text: str) -> Any:
    try:
        return _FROM_TEXT[name](text)
    except ValueError as error:
        raise InvalidArgument(
            f"The option {name} of Slurm's is a number, got {text!r}."
        ) from error

# SPDX-License-Identifier: Apache-2.0
"""Jobs on a Slurm cluster: arrays of Slurm jobs, and each does some of ours.

The outcomes of a run are files in its folder, which all machines see, so that nothing
depends on one Slurm job's life: a job that Slurm begins again does what it has not
done, and what an array has left undone is submitted once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Self

from ..errors import ClosedError, InvalidArgument, UnknownName
from ..machine import usable_cpus
from .gpu_shares import GpuShare, check_worker_count
from .slurm_arrays import ArrayRun
from .slurm_cluster import Cluster
from .worker import do_job

# What a cluster would grant is not known before; four are what nobody minds.
DEFAULT_WORKERS = 4

_SBATCH = "sbatch."


class SlurmEngine(Executor):
    """Runs jobs in Slurm jobs.

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
        time_min: their time limit in minutes. One that comes to it is put back into
            Slurm's queue and goes on where it was. The longest job has to fit.
        notice_s: so many seconds before its time limit a Slurm job ends. None is 120,
            or a quarter of a short limit.
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
        self.require_gpu = self.share.required if self.share.asked_for else None
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
        is_local = cluster == "local"
        self.workers = given or (usable_cpus() if is_local else DEFAULT_WORKERS)
        per_job = min(workers_per_job or _sharing(self.share), self.workers)
        self._per_job = per_job
        self._most_jobs = math.ceil(self.workers / per_job)
        gpus_per_job = math.ceil(self.share.each * per_job - 1e-9)
        if is_local:
            parameters: dict[str, Any] = {
                "timeout_min": time_min,
                "signal_delay_s": math.ceil(notice_s),
                "gpus_per_node": gpus_per_job,
                "setup": list(setup),
            }
        else:
            others = {k.replace("-", "_"): v for k, v in (sbatch or {}).items()}
            cpus = cpus_per_worker * per_job
            memory = None if mem_gb is None else math.ceil(1024 * mem_gb * per_job)
            asked = {
                "job_name": "mjrec",
                "time": time_min,
                "cpus_per_task": cpus,
                "mem": memory and f"{memory}M",
                "partition": partition,
                "account": account,
                "qos": qos,
                "constraint": constraint,
                "signal_delay_s": math.ceil(notice_s),
                "array_parallelism": self._most_jobs,
                "setup": list(setup) or None,
                # Since Slurm 22.05 a step does not get the job's CPUs by itself.
                "srun_args": [f"--cpus-per-task={cpus}"],
                "gpus_per_node": gpus_per_job or None,
            }
            if any(name.startswith(("gpu", "gres")) for name in others):
                asked["gpus_per_node"] = None
            parameters = {k: v for k, v in asked.items() if v is not None}
            parameters["additional_parameters"] = others
        self._cluster = Cluster(cluster or "slurm", parameters)
        self._runs: dict[str, ArrayRun] = {}
        self._is_shut_down = False

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
        where = ", cluster='local'" if self._cluster.name == "local" else ""
        return f"SlurmEngine(workers={self.workers}{where}{gpus})"

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Do a job of a `jobs.Run` in some Slurm job.

        Raises:
            ClosedError: it was shut down.
            InvalidArgument: it is another function.
        """
        if self._is_shut_down:
            raise ClosedError("The engine was shut down.")
        if fn is not do_job or len(args) != 1 or kwargs:
            raise InvalidArgument(
                "SlurmEngine does only jobs of mjrec, whose outcomes are files. For "
                "other functions use an executor of submitit's."
            )
        [message] = args
        place = message["work"]["place"]
        if place not in self._runs:
            self._runs[place] = ArrayRun(
                self._cluster,
                Path(place),
                most=self._most_jobs,
                workers=self._per_job,
                share=self.share,
            )
        future: Future[Any] = Future()
        self._runs[place].add(message, future)
        return future

    def end_run(self, place: str) -> None:
        """End the Slurm jobs of a run, and wait until they have ended. Idempotent."""
        run = self._runs.pop(place, None)
        if run is not None:
            run.cancel()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more jobs, and end those that run. Idempotent."""
        del wait, cancel_futures
        self._is_shut_down = True
        for place in [*self._runs]:
            self.end_run(place)


def _sharing(share: GpuShare) -> int:
    return max(1, math.floor(1 / share.each + 1e-9)) if share.asked_for else 1


def _check_whole(name: str, value: object) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidArgument(
            f"{name} must be a whole number of at least 1, got {value!r}."
        )


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

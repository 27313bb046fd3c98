# SPDX-License-Identifier: Apache-2.0
"""Jobs of a Slurm cluster: submitting them, asking what became of them, ending them.

`submitit` writes the scripts and submits them. What became of a job is asked of
`squeue`, which every cluster has; submitit asks `sacct`, which needs a database that
not every cluster keeps.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from ..errors import Error, InvalidArgument, MissingDependency
from .job_folder import JobFolder, Pace
from .job_folder_host import heard_signals, serve
from .local_worker import SECONDS_TO_CLOSE

CLUSTERS = ("slurm", "local")

_COMMANDS = ("sbatch", "squeue", "scancel", "srun")
_MOST_OF_ARRAY = 10_000
_LOG_LEVEL = "SUBMITIT_LOG_LEVEL"
_SECONDS_FOR_COMMAND = 60.0
_SECONDS_TO_DIE = 5.0
# What Python and its libraries take until the host begins, from a slow disk.
_SECONDS_TO_START = 5.0
_FINEST_LOOK = 0.05

_WAITING = frozenset(
    {"PENDING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT"}
    | {"RESV_DEL_HOLD"}
)
_RUNNING = frozenset(
    {"RUNNING", "COMPLETING", "CONFIGURING", "RESIZING", "SIGNALING", "STAGE_OUT"}
    | {"STOPPED", "SUSPENDED"}
)
# Ends for which what a job does is not to blame.
_NOT_TO_BLAME = frozenset(
    {"PREEMPTED", "NODE_FAIL", "BOOT_FAIL", "CANCELLED", "TIMEOUT", "DEADLINE"}
    | {"REVOKED", "COMPLETED"}
)
_GONE = "GONE"


class NotSubmitted(Error):
    """Slurm did not take a job; the message has what it said."""


@dataclass(frozen=True, kw_only=True)
class JobRequest:
    """What each Slurm job is asked for with.

    Attributes:
        workers: that it holds.
        cpus: of each worker.
        gpus: of the whole job.
        time_min: its time limit.
        notice_s: how long before that it is told.
        memory_gb: of the whole job; None is what the cluster gives.
        partition: to run in; None is the cluster's default, here and below.
        account: to charge.
        qos: quality of service.
        constraint: features of nodes.
        setup: lines of shell that run first.
        sbatch: other options of `sbatch`, without their dashes.
    """

    workers: int
    cpus: int = 1
    gpus: int = 0
    time_min: int = 60
    notice_s: float = 120
    memory_gb: float | None = None
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    setup: tuple[str, ...] = ()
    sbatch: Mapping[str, str | int | bool] = field(default_factory=dict)

    def for_slurm(self) -> dict[str, Any]:
        """Return submitit's parameters for Slurm."""
        cpus = self.cpus * self.workers
        sbatch = {name.replace("-", "_"): value for name, value in self.sbatch.items()}
        asked: dict[str, Any] = {
            "job_name": "mjrec",
            "time": self.time_min,
            "cpus_per_task": cpus,
            "mem": None if self.memory_gb is None else _megabytes(self.memory_gb),
            "partition": self.partition,
            "account": self.account,
            "qos": self.qos,
            "constraint": self.constraint,
            "signal_delay_s": math.ceil(self.notice_s),
            "array_parallelism": _MOST_OF_ARRAY,
            "setup": list(self.setup) or None,
            # Since Slurm 22.05 a step does not get the job's CPUs by itself.
            "srun_args": [f"--cpus-per-task={cpus}"],
        }
        if self.gpus and not any(name.startswith(("gpu", "gres")) for name in sbatch):
            asked["gpus_per_node"] = self.gpus
        if "requeue" not in sbatch:
            # The driver puts another in its place, at once.
            sbatch.setdefault("no_requeue", True)
        known = {name: value for name, value in asked.items() if value is not None}
        return {**known, "additional_parameters": sbatch}

    def for_local(self) -> dict[str, Any]:
        """Return submitit's parameters for processes of this machine."""
        return {
            "timeout_min": self.time_min,
            "signal_delay_s": math.ceil(self.notice_s),
            "gpus_per_node": self.gpus,
            "setup": list(self.setup),
        }


@dataclass(frozen=True, kw_only=True)
class JobState:
    """How it is with a Slurm job.

    Attributes:
        name: as Slurm has it, such as `RUNNING`, `OUT_OF_MEMORY`; `GONE` where it does
            not know of the job any more.
        reason: why it waits.
    """

    name: str
    reason: str = ""

    @property
    def is_waiting(self) -> bool:
        """Whether it has not begun, or is to begin again."""
        return self.name in _WAITING

    @property
    def is_over(self) -> bool:
        """Whether none of it runs or will run."""
        return self.name not in _WAITING | _RUNNING

    @property
    def is_to_blame(self) -> bool:
        """Whether it is over, and that may be because of what it did."""
        return self.is_over and self.name not in _NOT_TO_BLAME


class ClusterJobs(Protocol):
    """The jobs of one run on a cluster."""

    def submit(self, count: int) -> list[str]:
        """Submit so many; return their numbers, as the cluster has them.

        Raises:
            NotSubmitted: the cluster did not take them.
        """

    def states(self, jobs: Collection[str]) -> dict[str, JobState]:
        """Return how it is with jobs; nothing where that cannot be had now."""

    def end(self, jobs: Collection[str]) -> None:
        """Let jobs end: SIGTERM, and some seconds later SIGKILL."""

    def log_of(self, job: str) -> Path:
        """Return the file that a job prints into."""


def check_cluster(cluster: str | None) -> str:
    """Return the cluster's name, if jobs can be submitted to it from here.

    Raises:
        InvalidArgument: there is no such cluster.
        MissingDependency: submitit is not installed.
        Error: this machine has no commands of Slurm's.
    """
    name = cluster or "slurm"
    if name not in CLUSTERS:
        raise InvalidArgument(
            f"cluster is {' or '.join(map(repr, CLUSTERS))}, got {cluster!r}."
        )
    _submitit()
    missing = [command for command in _COMMANDS if shutil.which(command) is None]
    if name == "slurm" and missing:
        raise Error(
            f"This machine has no {', '.join(missing)} on its PATH, with which jobs of "
            "a Slurm cluster are submitted and looked after. Run mjrec where Slurm's "
            "commands are: on the cluster's login node, or in a Slurm job. "
            'cluster="local" (--engine-option cluster=local) tries it out with '
            "processes of this machine."
        )
    return name


def cluster_jobs(
    cluster: str, folder: JobFolder, request: JobRequest, pace: Pace
) -> ClusterJobs:
    """Return the jobs that serve a folder, none as yet."""
    return (LocalJobs if cluster == "local" else SlurmJobs)(folder, request, pace)


class SlurmJobs:
    """Jobs of the Slurm cluster that this machine belongs to."""

    def __init__(self, folder: JobFolder, request: JobRequest, pace: Pace) -> None:
        self._submission = _Submission(folder, request, pace)
        self._parameters = request.for_slurm()

    def submit(self, count: int) -> list[str]:
        """Submit so many, as one array. As of the protocol."""
        executor = _submitit().SlurmExecutor(self._submission.logs)
        executor.update_parameters(**self._parameters)
        with _as_from_outside():
            return self._submission.to(executor, count)

    def states(self, jobs: Collection[str]) -> dict[str, JobState]:
        """Return how it is with jobs. As of the protocol."""
        if not jobs:
            return {}
        of_arrays = sorted({job.partition("_")[0] for job in jobs})
        asked = _command(
            *("squeue", "--noheader", "--array", "--states=all"),
            *("--format=%i|%T|%r", f"--jobs={','.join(of_arrays)}"),
        )
        if asked is None or (asked.returncode and "Invalid job id" not in asked.stderr):
            return {}
        states = {job: JobState(name=_GONE) for job in jobs}
        for line in asked.stdout.splitlines():
            job, _, rest = line.strip().partition("|")
            name, _, reason = rest.partition("|")
            if job in states:
                states[job] = JobState(name=name, reason=reason)
        return states

    def end(self, jobs: Collection[str]) -> None:
        """Let jobs end. As of the protocol."""
        if jobs:
            _command("scancel", "--quiet", *jobs)

    def log_of(self, job: str) -> Path:
        """Return the file that a job prints into."""
        return self._submission.log_of(job)


class LocalJobs:
    """Processes of this machine, which submitit starts as if they were jobs."""

    def __init__(self, folder: JobFolder, request: JobRequest, pace: Pace) -> None:
        self._submission = _Submission(folder, request, pace)
        self._parameters = request.for_local()

    def submit(self, count: int) -> list[str]:
        """Start so many. As of the protocol."""
        executor = _submitit().LocalExecutor(self._submission.logs)
        executor.update_parameters(**self._parameters)
        return self._submission.to(executor, count)

    def states(self, jobs: Collection[str]) -> dict[str, JobState]:
        """Return how it is with jobs. As of the protocol."""
        # How one has ended nobody knows.
        return {
            job: JobState(name="RUNNING" if self._runs(job) else "FAILED")
            for job in jobs
        }

    def end(self, jobs: Collection[str]) -> None:
        """Let jobs end. As of the protocol."""
        running = {job for job in jobs if self._runs(job)}
        for signum, seconds in (
            (signal.SIGTERM, SECONDS_TO_CLOSE + _SECONDS_TO_DIE),
            (signal.SIGKILL, _SECONDS_TO_DIE),
        ):
            deadline = time.monotonic() + seconds
            for job in running:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(job), signum)
            while running and time.monotonic() < deadline:
                time.sleep(_FINEST_LOOK)
                running = {job for job in running if self._runs(job)}

    def log_of(self, job: str) -> Path:
        """Return the file that a job prints into."""
        return self._submission.log_of(job)

    def _runs(self, job: str) -> bool:
        started = self._submission.jobs.get(job)
        if started is not None:
            # Which also lets it go, where it has ended.
            return bool(started.state == "RUNNING")
        # Another driver's. Its number may be another process's by now.
        with contextlib.suppress(OSError):
            command = Path("/proc", job, "cmdline").read_bytes()
            return os.fsencode(self._submission.logs) in command
        return False


class _Submission:
    """What is submitted, again and again."""

    def __init__(self, folder: JobFolder, request: JobRequest, pace: Pace) -> None:
        self.logs = folder.logs
        self._folder = folder
        self._arguments = (
            str(folder.path),
            request.workers,
            60.0 * request.time_min,
            pace,
        )
        self.jobs: dict[str, Any] = {}

    def to(self, executor: Any, count: int) -> list[str]:
        """Submit so many; return their numbers.

        Raises:
            NotSubmitted: the cluster did not take them.
        """
        columns = [[argument] * count for argument in self._arguments]
        try:
            with _undisturbed():
                new = executor.map_array(_serve_in_job, *columns)
        except (OSError, RuntimeError, subprocess.SubprocessError) as error:
            said = " ".join(str(error).split())
            raise NotSubmitted(f"No job could be submitted: {said}") from error
        self.jobs.update((job.job_id, job) for job in new)
        numbers = [job.job_id for job in new]
        self._folder.note_submitted(numbers)
        return numbers

    def log_of(self, job: str) -> Path:
        path: Path = self.jobs[job].paths.stderr
        return path


def _serve_in_job(folder: str, workers: int, limit_s: float, pace: Pace) -> None:
    """Be a host; this is what submitit runs in a Slurm job."""
    environment = _submitit().JobEnvironment()
    # A job that Slurm begins again has the number that it had.
    begun = os.environ.get("SLURM_RESTART_COUNT", "0")
    # submitit would take no notice of SIGTERM, and put the job back into Slurm's queue
    # at its own signal.
    with heard_signals(
        end=[signal.SIGTERM, signal.SIGINT, signal.SIGHUP],
        end_soon=signal.Signals[f"SIG{environment.USR_SIG}"],
    ) as notice:
        serve(
            JobFolder(Path(folder)),
            host=f"{environment.job_id}-{begun}",
            workers=workers,
            notice=notice,
            limit_s=limit_s - _SECONDS_TO_START,
            pace=pace,
        )


def _submitit() -> ModuleType:
    """Return the module.

    Raises:
        MissingDependency: it is not installed.
    """
    # Else it would configure the process's logging, and close handlers on the way.
    # Slurm jobs do not inherit it, and have submitit's words in their logs.
    quiet = "submitit" not in sys.modules and _LOG_LEVEL not in os.environ
    if quiet:
        os.environ[_LOG_LEVEL] = "NOCONFIG"
    try:
        # Optional, and not quick to import.
        import submitit
    except ImportError as error:
        raise MissingDependency(
            "submitit", purpose='engine="slurm"', install='pip install "mjrec[slurm]"'
        ) from error
    finally:
        if quiet:
            del os.environ[_LOG_LEVEL]
    return submitit


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep Ctrl-C off until what is submitted is known, and off what is started."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextlib.contextmanager
def _as_from_outside() -> Iterator[None]:
    """Submit from inside a Slurm job as from outside.

    What that job was given (its CPUs, its memory) would be taken for what is asked for.
    """
    inside = (
        [name for name in os.environ if name.startswith(("SLURM_", "SLURMD_", "SRUN_"))]
        if "SLURM_JOB_ID" in os.environ
        else []
    )
    # Where the cluster is stays as it is.
    hidden = {n: os.environ.pop(n) for n in inside if n != "SLURM_CONF"}
    try:
        yield
    finally:
        os.environ.update(hidden)


def _command(*words: str) -> subprocess.CompletedProcess[str] | None:
    """Run a command of Slurm's; return nothing if it does not answer."""
    try:
        return subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_SECONDS_FOR_COMMAND,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None


def _megabytes(gigabytes: float) -> str:
    return f"{math.ceil(gigabytes * 1024)}M"

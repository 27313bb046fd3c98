# SPDX-License-Identifier: Apache-2.0
"""Submitting Slurm jobs, asking what became of them, ending them.

`submitit` writes the scripts and submits them. What became of a job is asked of
`squeue`, which every cluster has; submitit asks `sacct`, which needs a database that
not every cluster keeps, and only every ten minutes.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import Error, InvalidArgument, MissingDependency
from .worker import SECONDS_TO_CLOSE

CLUSTERS = ("slurm", "local")

_COMMANDS = ("sbatch", "squeue", "scancel", "srun")
_LOG_LEVEL = "SUBMITIT_LOG_LEVEL"
_SECONDS_FOR_COMMAND = 60.0
_SECONDS_TO_DIE = 5.0
_SECONDS_BETWEEN_LOOKS = 0.2

_NOT_OVER = frozenset(
    {"PENDING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT"}
    | {"RESV_DEL_HOLD", "RUNNING", "COMPLETING", "CONFIGURING", "RESIZING"}
    | {"SIGNALING", "STAGE_OUT", "STOPPED", "SUSPENDED"}
)


class NotSubmitted(Error):
    """Slurm did not take a job; the message has what it said."""


@dataclass(frozen=True)
class JobState:
    """The state of a Slurm job.

    Attributes:
        name: as Slurm has it, such as `RUNNING`, `OUT_OF_MEMORY`; `GONE` where it does
            not know of the job any more.
        reason: why it waits.
    """

    name: str
    reason: str = ""

    @property
    def is_over(self) -> bool:
        """Whether none of it runs or will run."""
        return self.name not in _NOT_OVER


class Cluster:
    """The Slurm cluster that this machine belongs to, or a stand-in for one.

    Args:
        name: `"slurm"`, or `"local"`: processes of this machine in place of jobs.
        parameters: submitit's, for each job.

    Raises:
        InvalidArgument: there is no such cluster.
        MissingDependency: submitit is not installed.
        Error: this machine has no commands of Slurm's.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any]) -> None:
        if name not in CLUSTERS:
            raise InvalidArgument(
                f"cluster is {' or '.join(map(repr, CLUSTERS))}, got {name!r}."
            )
        _submitit()
        missing = [command for command in _COMMANDS if shutil.which(command) is None]
        if name == "slurm" and missing:
            raise Error(
                f"This machine has no {', '.join(missing)} on its PATH, with which "
                "jobs of a Slurm cluster are submitted and looked after. Run mjrec "
                "where Slurm's commands are: on the cluster's login node, or in a "
                'Slurm job. cluster="local" (--engine-option cluster=local) tries it '
                "out with processes of this machine."
            )
        self.name = name
        self._parameters = parameters
        # Those that stand in for Slurm jobs, by their numbers.
        self._processes: dict[str, Any] = {}

    def submit(
        self, function: Callable[[Any], Any], each: Sequence[Any], *, logs: Path
    ) -> list[str]:
        """Submit a job for each of some arguments, as one array.

        Args:
            function: called in each job, with one of the arguments.
            each: the arguments.
            logs: folder of what the jobs print, and of submitit's files.

        Returns:
            The jobs' numbers.

        Raises:
            NotSubmitted: the cluster did not take them.
        """
        submitit = _submitit()
        kind = (
            submitit.SlurmExecutor if self.name == "slurm" else submitit.LocalExecutor
        )
        executor = kind(logs)
        executor.update_parameters(**self._parameters)
        try:
            with _undisturbed(), _as_from_outside():
                jobs = executor.map_array(function, each)
        except (OSError, RuntimeError, subprocess.SubprocessError) as error:
            said = " ".join(str(error).split())
            raise NotSubmitted(f"No job could be submitted: {said}") from error
        if self.name == "local":
            self._processes.update((job.job_id, job) for job in jobs)
        return [job.job_id for job in jobs]

    def states(self, jobs: Collection[str]) -> dict[str, JobState]:
        """Return the states of jobs; nothing where they cannot be had now."""
        if not jobs:
            return {}
        if self.name == "local":
            # How one has ended is not known.
            return {
                job: JobState("RUNNING" if self._runs(job) else "ENDED") for job in jobs
            }
        of_arrays = sorted({job.partition("_")[0] for job in jobs})
        asked = _command(
            *("squeue", "--noheader", "--array", "--states=all"),
            *("--format=%i|%T|%r", f"--jobs={','.join(of_arrays)}"),
        )
        if asked is None or (asked.returncode and "Invalid job id" not in asked.stderr):
            return {}
        states = dict.fromkeys(jobs, JobState("GONE"))
        for line in asked.stdout.splitlines():
            job, _, rest = line.strip().partition("|")
            name, _, reason = rest.partition("|")
            if job in states:
                states[job] = JobState(name, reason)
        return states

    def end(self, jobs: Collection[str]) -> None:
        """Let jobs end: SIGTERM, and some seconds later SIGKILL."""
        if self.name == "slurm":
            if jobs:
                _command("scancel", "--quiet", *sorted(jobs))
            return
        running = {job for job in jobs if self._runs(job)}
        for signum, seconds in (
            (signal.SIGTERM, SECONDS_TO_CLOSE + _SECONDS_TO_DIE),
            (signal.SIGKILL, _SECONDS_TO_DIE),
        ):
            deadline = time.monotonic() + seconds
            while running and time.monotonic() < deadline:
                for job in running:
                    # Again and again: one that has not begun yet passes it on to none.
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(int(job), signum)
                time.sleep(_SECONDS_BETWEEN_LOOKS)
                running = {job for job in running if self._runs(job)}

    def _runs(self, pid: str) -> bool:
        """Tell whether a process runs that stands in for a Slurm job."""
        if pid in self._processes:
            # Which also lets go of it where it has ended.
            return bool(self._processes[pid].state == "RUNNING")
        # Another driver's. Its number may be another process's by now.
        try:
            return b"submitit" in Path("/proc", pid, "cmdline").read_bytes()
        except OSError:
            return False


def _submitit() -> ModuleType:
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

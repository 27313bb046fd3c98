# SPDX-License-Identifier: Apache-2.0
"""An engine for Slurm: arrays of Slurm jobs that each do some jobs of a run.

Outcomes are files in the run's folder, which all machines see, so that nothing depends
on the survival of a single Slurm job. A Slurm job that is requeued does only its
remaining jobs, and jobs that an array did not finish are resubmitted. The files in that
folder are::

    slurm/outcomes/17.json   the return value of `worker.do_job` for job 17
    slurm/logs/              output of the Slurm jobs, and submitit's own files

`submitit` writes the scripts and submits them. The states of Slurm jobs come from
`squeue`, which every cluster has. submitit itself uses `sacct`, which needs a database
that not every cluster has, and queries it only every ten minutes.
"""

from __future__ import annotations

import contextlib
import inspect
import itertools
import json
import logging
import math
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic_files import write_text
from ..child_python import changed_environ
from ..errors import ClosedError, Error, InvalidArgument, UnknownName, optional_module
from ..machine import usable_cpus
from ..plain_text import counted
from .local import GpuShare, LocalEngine, check_worker_count
from .worker import do_job, end_idle_children

logger = logging.getLogger(__name__)

# The number of jobs that a cluster would run in parallel is unknown; four is always
# acceptable.
DEFAULT_WORKERS = 4

_CLUSTERS = ("slurm", "local")
_COMMANDS = ("sbatch", "squeue", "scancel", "srun")
_SBATCH = "sbatch."
# Several elements per worker, so that the last jobs end at about the same time.
_ELEMENTS_PER_WORKER = 4
_SECONDS_BETWEEN_LOOKS = 0.2
_SECONDS_BETWEEN_QUESTIONS = 10.0
_SECONDS_FOR_COMMAND = 60.0
_SECONDS_WITHOUT_START = 60.0
_SECONDS_TO_COMPLETE = 5.0
_SECONDS_TO_END = 15.0
_END_OF_LOG = 2000
_NOT_OVER = frozenset(
    {"PENDING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT"}
    | {"RESV_DEL_HOLD", "RUNNING", "COMPLETING", "CONFIGURING", "RESIZING"}
    | {"SIGNALING", "STAGE_OUT", "STOPPED", "SUSPENDED"}
)


@dataclass(frozen=True, eq=False)
class _Task:
    """A job in a run, with its future."""

    number: int
    place: Path
    job: Mapping[str, Any]
    future: Future[Any]


class SlurmEngine(Executor):
    """An engine that runs jobs inside Slurm jobs.

    Args:
        workers: maximum total number of workers in all Slurm jobs. None means 4, or one
            per usable CPU with `cluster="local"`.
        cluster: None means this machine's Slurm cluster. `"local"` uses processes on
            this machine instead of Slurm jobs, so that you can try the engine.
        gpus: number of GPUs for each worker, which may be a fraction: with 0.25, four
            workers share a GPU.
        require_gpu: whether a worker that was given a GPU but renders in software is an
            error instead of a warning.
        cpus_per_worker: number of CPUs per worker.
        workers_per_job: number of workers in one Slurm job, on one machine. None means
            as many as share a GPU, or one without sharing.
        partition: partition for the Slurm jobs. Here and below, None means the
            cluster's default.
        account: account charged for the jobs.
        qos: quality of service.
        constraint: features that nodes must have.
        time_min: time limit for a Slurm job, in minutes. A Slurm job that reaches the
            limit is requeued and continues. The limit must exceed the longest job.
        notice_s: how many seconds before the time limit a Slurm job stops. None means
            120, or a quarter of the limit if that is shorter.
        mem_gb: memory per worker, in gigabytes.
        setup: shell commands that run first in a Slurm job, one per line.
        sbatch: other options for `sbatch`, by name, without dashes.

    Raises:
        InvalidArgument: an argument is invalid.
        MissingDependency: submitit is not installed.
        Error: this machine does not have the Slurm commands.
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
        check_worker_count(cpus_per_worker, "cpus_per_worker")
        check_worker_count(time_min, "time_min")
        check_worker_count(workers_per_job, "workers_per_job")
        self.share = GpuShare(each=gpus, required=require_gpu)
        if mem_gb is not None and not mem_gb > 0:
            raise InvalidArgument(f"mem_gb must be more than 0, but it is {mem_gb!r}.")
        notice = min(120.0, 60 * time_min / 4) if notice_s is None else notice_s
        if not 0 <= notice < 60 * time_min:
            raise InvalidArgument(
                "notice_s, in seconds, must be less than the time limit of "
                f"{time_min} minutes (time_min), but it is {notice_s!r}."
            )
        self._cluster = cluster or "slurm"
        self._submitit = _submitit(self._cluster)
        default = usable_cpus() if cluster == "local" else DEFAULT_WORKERS
        self.workers = check_worker_count(workers) or default
        per_job = min(workers_per_job or self.share.sharing, self.workers)
        cpus = cpus_per_worker * per_job
        others = {k.replace("-", "_"): v for k, v in (sbatch or {}).items()}
        names_gpus = any(name.startswith(("gpu", "gres")) for name in others)
        self._per_job = per_job
        self._most_jobs = math.ceil(self.workers / per_job)
        # Named GPUs are requested by the other options.
        needed_gpus = 0 if names_gpus else math.ceil(gpus * per_job - 1e-9)
        self._parameters = {
            "name": "mjrec",
            "timeout_min": time_min,
            "cpus_per_task": cpus,
            "mem_gb": mem_gb and mem_gb * per_job,
            "gpus_per_node": needed_gpus or None,
            "slurm_partition": partition,
            "slurm_account": account,
            "slurm_qos": qos,
            "slurm_constraint": constraint,
            "slurm_signal_delay_s": math.ceil(notice),
            "slurm_array_parallelism": self._most_jobs,
            "slurm_setup": list(setup) or None,
            "local_setup": list(setup),
            # Since Slurm 22.05, a step does not inherit the job's CPUs automatically.
            "slurm_srun_args": [f"--cpus-per-task={cpus}"],
            "slurm_additional_parameters": others,
        }
        self._numbers = itertools.count()
        self._waiting: list[_Task] = []
        # The tasks, keyed by the submitit job that does them.
        self._elements: dict[Any, list[_Task]] = {}
        self._last_added = self._last_asked = -math.inf
        self._last_progress = 0.0
        self._one_at_a_time = threading.Lock()
        self._thread: threading.Thread | None = None
        self._is_shut_down = False

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        where = ", cluster='local'" if self._cluster == "local" else ""
        return f"SlurmEngine(workers={self.workers}{where}{gpus})"

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Run a job of a `jobs.Run` in one of the Slurm jobs.

        Raises:
            ClosedError: the engine was shut down.
            InvalidArgument: `fn` is not `worker.do_job`.
        """
        if self._is_shut_down:
            raise ClosedError("The engine was shut down.")
        if fn is not do_job:
            raise InvalidArgument(
                "SlurmEngine runs only mjrec's own jobs, whose outcomes are files. "
                "Use a submitit executor for other functions."
            )
        place, job = args
        task = _Task(next(self._numbers), Path(place, "slurm"), job, Future())
        with self._one_at_a_time:
            self._waiting.append(task)
            self._last_added = time.monotonic()
            if self._thread is None:
                self._last_progress = time.monotonic()
                self._thread = threading.Thread(
                    target=self._follow, name="mjrec-slurm", daemon=True
                )
                self._thread.start()
        return task.future

    def end_run(self, place: str) -> None:
        """End the Slurm jobs of a run, and wait until they have ended. Idempotent.

        A Slurm job that has unfinished work is canceled at once. The others have a few
        seconds to complete.
        """
        with self._one_at_a_time:
            self._waiting = [t for t in self._waiting if t.place.parent != Path(place)]
            elements = self._elements.items()
            of_run = {j: of for j, of in elements if of[0].place.parent == Path(place)}
            finished = {j for j, of in of_run.items() if all(map(_is_finished, of))}
            self._cancel(of_run.keys() - finished)
            self._cancel(self._unended(finished, _SECONDS_TO_COMPLETE))
            self._unended(of_run, _SECONDS_TO_END)
            for job in of_run:
                del self._elements[job]

    def _cancel(self, jobs: Collection[Any]) -> None:
        # Local processes exit on their own.
        if jobs and self._cluster == "slurm":
            _command("scancel", "--quiet", *sorted(job.job_id for job in jobs))

    def _unended(self, jobs: Collection[Any], seconds: float) -> set[Any]:
        """Wait until jobs have ended, and return those that have not ended in time."""
        running = {*jobs}
        deadline = time.monotonic() + seconds
        # If Slurm does not answer, the deadline ends the wait.
        while running and time.monotonic() < deadline:
            states = self._states(running)
            running -= {job for job in states if states[job][0] not in _NOT_OVER}
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        return running

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more jobs. Idempotent."""
        del wait, cancel_futures
        self._is_shut_down = True

    def _follow(self) -> None:
        """Submit jobs and collect their outcomes until no jobs are left."""
        while True:
            time.sleep(_SECONDS_BETWEEN_LOOKS)
            with self._one_at_a_time:
                if not (self._waiting or self._elements):
                    self._thread = None
                    return
                try:
                    self._submit_waiting()
                    self._take_outcomes()
                    self._ask()
                except Exception as error:
                    tasks = [*self._waiting, *itertools.chain(*self._elements.values())]
                    self._waiting.clear()
                    self._elements.clear()
                    for task in tasks:
                        if not task.future.done():
                            task.future.set_exception(error)

    def _submit_waiting(self) -> None:
        now = time.monotonic()
        free = self._most_jobs - len(self._elements)
        # Wait a moment, so that jobs submitted at the same time share an array.
        is_whole = now - self._last_added > _SECONDS_BETWEEN_LOOKS
        if not self._waiting or not is_whole or free <= 0:
            return
        # If nothing is running, the cluster itself enforces the limit within the new
        # array.
        most = free if self._elements else self._most_jobs * _ELEMENTS_PER_WORKER
        place = self._waiting[0].place
        tasks = [task for task in self._waiting if task.place == place]
        count = min(len(tasks), most)
        shares = [tasks[first::count] for first in range(count)]
        (place / "outcomes").mkdir(parents=True, exist_ok=True)
        executor = self._submitit.AutoExecutor(place / "logs", cluster=self._cluster)
        executor.update_parameters(**self._parameters)
        do = ArrayElement(place, self._per_job, self.share)
        each = [{task.number: dict(task.job) for task in share} for share in shares]
        try:
            with _as_from_outside():
                jobs = executor.map_array(do, each)
        except (OSError, RuntimeError, subprocess.SubprocessError) as error:
            answer = " ".join(str(error).split())
            raise Error(f"No job could be submitted: {answer}") from error
        self._waiting = [task for task in self._waiting if task.place != place]
        self._elements.update(zip(jobs, shares, strict=True))

    def _take_outcomes(self) -> None:
        for place in {tasks[0].place for tasks in self._elements.values()}:
            done = {path.stem: path for path in (place / "outcomes").glob("*.json")}
            for tasks in self._elements.values():
                for task in tasks:
                    if str(task.number) in done and not task.future.done():
                        self._last_progress = time.monotonic()
                        _resolve(task, json.loads(done[str(task.number)].read_bytes()))

    def _ask(self) -> None:
        """Query the states of Slurm jobs, and handle those that have ended."""
        now = time.monotonic()
        is_local = self._cluster == "local"
        if not is_local and now - self._last_asked < _SECONDS_BETWEEN_QUESTIONS:
            return
        self._last_asked = now
        states = self._states(self._elements)
        over = {job for job, (state, _) in states.items() if state not in _NOT_OVER}
        if over:
            # Collect the outcomes that these jobs wrote before they ended.
            self._take_outcomes()
        for job in over:
            for task in self._elements.pop(job):
                how = (
                    f"was in the Slurm job {job.job_id}, which ended "
                    f"({states[job][0]}). The end of that job's log: "
                    f"{_end_of_log(task.place, job.job_id)}"
                )
                _resolve(task, {"died": how, "begun": True})
        if states and now - self._last_progress > _SECONDS_WITHOUT_START:
            self._last_progress = now
            if {state for state, _ in states.values()} == {"PENDING"}:
                reasons = {reason for _, reason in states.values() if reason}
                logger.warning(
                    "Slurm has not started %s for a minute. Its reason: %s.",
                    counted(len(states), "Slurm job"),
                    ", ".join(sorted(reasons)) or "none",
                )

    def _states(self, jobs: Collection[Any]) -> dict[Any, tuple[str, str]]:
        """Return the jobs' states and reasons, or {} if Slurm does not answer."""
        if self._cluster == "local":
            return {job: (job.state, "") for job in jobs}
        if not jobs:
            return {}
        by_id = {job.job_id: job for job in jobs}
        of_arrays = sorted({job_id.partition("_")[0] for job_id in by_id})
        asked = _command(
            *("squeue", "--noheader", "--array", "--states=all"),
            *("--format=%i|%T|%r", f"--jobs={','.join(of_arrays)}"),
        )
        if asked is None or (asked.returncode and "Invalid job id" not in asked.stderr):
            return {}
        states = dict.fromkeys(jobs, ("GONE", ""))
        for line in asked.stdout.splitlines():
            job_id, state, reason = line.strip().split("|", 2)
            if job_id in by_id:
                states[by_id[job_id]] = state, reason
        return states


# Set when this Slurm job is about to be requeued.
_is_ending = threading.Event()


@dataclass
class ArrayElement:
    """The callable that submitit runs in a Slurm job and requeues.

    Attributes:
        place: the folder `slurm` in the run's folder.
        workers: number of workers that do jobs in parallel.
        share: each worker's share of the Slurm job's GPUs.
    """

    place: Path
    workers: int
    share: GpuShare

    def __call__(self, jobs: Mapping[int, Mapping[str, Any]]) -> None:
        """Do the jobs that do not have an outcome yet.

        Args:
            jobs: the jobs, keyed by number.
        """
        # submitit does not handle SIGTERM. Children exit with this process.
        signal.signal(signal.SIGTERM, lambda *_: os._exit(1))
        run = str(self.place.parent)

        def do(number: int) -> None:
            path = self.place / "outcomes" / f"{number}.json"
            if path.exists() or _is_ending.is_set():
                return
            answer = do_job(run, jobs[number])
            # If the child died because this Slurm job is ending, the job has not
            # failed.
            if "died" not in answer or not _is_ending.wait(_SECONDS_BETWEEN_LOOKS):
                with contextlib.suppress(Error):
                    write_text(path, json.dumps(answer))

        with LocalEngine(self.workers, gpus=self.share.each) as engine:
            for future in [engine.submit(do, number) for number in jobs]:
                future.result()
        end_idle_children(run)

    def checkpoint(self, jobs: Mapping[int, Mapping[str, Any]]) -> Any:
        """Return the submission that resumes the jobs after a timeout or preemption."""
        _is_ending.set()
        return _submitit("local").helpers.DelayedSubmission(self, jobs)


def slurm_options(texts: Mapping[str, str]) -> dict[str, Any]:
    """Convert command-line options to parameters of `SlurmEngine`.

    Args:
        texts: values by parameter name; `sbatch.NAME` is an option of `sbatch`, and
            `setup` is a single line.

    Raises:
        UnknownName: an option does not exist.
        InvalidArgument: a value is not a number.
    """
    options: dict[str, Any] = {}
    sbatch: dict[str, str | bool] = {}
    kinds = inspect.signature(SlurmEngine).parameters
    known = [name for name in kinds if name not in _ELSEWHERE]
    for name, text in texts.items():
        if name.startswith(_SBATCH):
            sbatch[name.removeprefix(_SBATCH)] = text or True
        elif name not in known:
            raise UnknownName(
                "Slurm option",
                name,
                [*known, f"{_SBATCH}NAME"],
                hint=f"Give other options of sbatch as {_SBATCH}NAME=VALUE.",
            )
        elif name == "setup":
            options[name] = (text,)
        else:
            kind = str(kinds[name].annotation).partition(" ")[0]
            try:
                options[name] = {"int": int, "float": float, "str": str}[kind](text)
            except ValueError as error:
                raise InvalidArgument(
                    f"The Slurm option {name} must be a number, not {text!r}."
                ) from error
    return {**options, "sbatch": sbatch}


# Parameters that have separate command-line options.
_ELSEWHERE = ("workers", "gpus", "require_gpu", "sbatch")


def _is_finished(task: _Task) -> bool:
    return task.future.done() and not task.future.cancelled()


def _resolve(task: _Task, answer: Any) -> None:
    if not task.future.done() and task.future.set_running_or_notify_cancel():
        task.future.set_result(answer)


def _end_of_log(place: Path, job: str) -> str:
    answer = b""
    for path in (place / "logs").glob(f"{job}_*log.err"):
        with contextlib.suppress(OSError):
            answer = path.read_bytes()[-_END_OF_LOG:]
    return answer.decode(errors="replace").strip() or "(nothing)"


def _submitit(cluster: str) -> Any:
    if cluster not in _CLUSTERS:
        raise InvalidArgument(
            f"cluster must be {' or '.join(map(repr, _CLUSTERS))}, not {cluster!r}."
        )
    # Without this setting, submitit would reconfigure the process's logging and close
    # its handlers. Slurm jobs do not inherit the setting, so their logs contain
    # submitit's messages.
    level = {"SUBMITIT_LOG_LEVEL": os.environ.get("SUBMITIT_LOG_LEVEL", "NOCONFIG")}
    with changed_environ(level):
        submitit = optional_module(
            "submitit", purpose='engine="slurm"', install="mjrec[slurm]"
        )
    missing = [command for command in _COMMANDS if shutil.which(command) is None]
    if cluster == "slurm" and missing:
        raise Error(
            f"This machine has no {', '.join(missing)} on its PATH. Run mjrec where "
            "Slurm's commands are installed: on the cluster's login node, or in a "
            'Slurm job. To try the engine with local processes, use cluster="local" '
            "(--engine-option cluster=local)."
        )
    return submitit


def _as_from_outside() -> contextlib.AbstractContextManager[None]:
    """Hide the enclosing Slurm job, if any, from commands inside the block.

    Otherwise that job's resources (its CPUs and memory) would be mistaken for the
    requested ones.
    """
    # SLURM_CONF is kept, because it locates the cluster.
    names = {n for n in os.environ if n.startswith(("SLURM_", "SLURMD_", "SRUN_"))}
    is_inside = "SLURM_JOB_ID" in names
    hidden = dict.fromkeys(names - {"SLURM_CONF"}) if is_inside else {}
    return changed_environ(hidden)


def _command(*words: str) -> subprocess.CompletedProcess[str] | None:
    """Run a Slurm command and return the result, or None if it does not answer."""
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

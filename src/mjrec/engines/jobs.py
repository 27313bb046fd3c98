# SPDX-License-Identifier: Apache-2.0
"""Jobs that are submitted to an executor and monitored until they are done.

An engine is a `concurrent.futures.Executor`: one of ours (`LocalEngine`, `RayEngine`,
`SlurmEngine`) or any other executor whose workers see the same directory. The executor
calls `worker.do_job` with plain data. That function does the job in a child process of
the worker, so a crash affects only one job, not the executor.

Doing a job twice is harmless, so if the child dies, the job is resubmitted.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import queue
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from ..errors import DirectoryNotWritable, Error, InvalidArgument
from ..messages import unpacked
from .local import LocalEngine
from .worker import BEGUN, WORK, do_job, end_idle_children

logger = logging.getLogger(__name__)

# The folder in `Work.shared_directory` with the files that children need during a run.
WORK_FOLDER = ".mjrec.work"

TRIES = 3

_OF_MUJOCO = "simulation.warnings"
_NUMBERS = re.compile(r"[\d.]+")

# Not from `tempfile`, because it imports `random`, and a user's script may have that
# name.
_TEMPORARY = Path(os.environ.get("TMPDIR") or "/tmp")


@dataclass(frozen=True, kw_only=True)
class Work:
    """The work for a run's children.

    Attributes:
        entry: `module:name` of a function that creates a handler. It is called once in
            each child, with the settings. The handler is called with the arguments of
            each job in turn, and returns a small JSON object. If the handler has a
            `leave` method, it is called on another thread when the child has to exit
            for reasons other than its own failure.
        settings: settings for all jobs, as JSON.
        environ: environment variables for the children, in addition to the worker's.
        shared_directory: a directory that all workers see under this path; a folder in
            it is used during the run. None is allowed if all processes are on this
            machine.
        payload: bytes for all children. They are written to a file, whose path is added
            to the settings as `payload`.
    """

    entry: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    environ: Mapping[str, str] = field(default_factory=dict)
    shared_directory: Path | None = None
    payload: bytes | None = None


@dataclass(frozen=True, kw_only=True)
class JobOutcome:
    """The outcome of a job.

    Attributes:
        key: the job's key.
        value: the handler's return value; None if the job failed.
        failure: the handler's error, or how the child died; None if the job succeeded.
    """

    key: str
    value: Mapping[str, Any] | None
    failure: str | None = None


@dataclass
class _Task:
    key: str
    arguments: Mapping[str, Any]
    deaths: int = 0


class Run:
    """A run of a `Work` on an executor.

    Leaving the `with` block cancels unfinished jobs.

    Args:
        engine: the executor. It is not shut down.
        work: the work to do.

    Raises:
        InvalidArgument: the executor's workers may be on other machines, but the work
            has no shared directory.
        DirectoryNotWritable: the shared directory is not writable.
    """

    def __init__(self, engine: Executor, work: Work) -> None:
        self._engine = engine
        is_here = isinstance(engine, LocalEngine)
        if not is_here and work.shared_directory is None:
            raise InvalidArgument(
                "Workers on other machines need a directory that all workers see. Set "
                "the shared_directory of this work."
            )
        self._place = _new_place(None if is_here else work.shared_directory)
        settings = dict(work.settings)
        if work.payload is not None:
            settings["payload"] = str(self._place / "payload")
            (self._place / "payload").write_bytes(work.payload)
        share = getattr(engine, "share", None)
        # The file stays locked while this process is running.
        self._file = (self._place / WORK).open("w")
        fcntl.flock(self._file, fcntl.LOCK_EX)
        json.dump(
            {
                "entry": work.entry,
                "settings": settings,
                "environ": dict(work.environ),
                "require_gpu": share.required if share and share.asked_for else None,
                # This ensures that a policy's modules are found as in the driver.
                "directory": str(Path.cwd()),
                "path": [str(Path(entry).absolute()) for entry in sys.path],
            },
            self._file,
        )
        self._file.flush()
        self._tasks: dict[Future[Any], _Task] = {}
        self._parked: list[_Task] = []
        self._done: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
        self._told: set[tuple[str, int, str]] = set()

    def submit(self, key: str, **arguments: Any) -> None:
        """Add a job. Jobs may also be added while results arrive.

        Args:
            key: a key that is unique within the run.
            **arguments: the handler's arguments, as JSON.
        """
        self._hand_out(_Task(key, arguments))

    def results(self, *, timeout_s: float | None = None) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they arrive, until no jobs are left.

        If a job's child dies, the job is retried after the other jobs. A job is tried
        up to `TRIES` times.

        Args:
            timeout_s: yield None whenever no outcome has arrived for this many seconds;
                None means no timeout.

        Raises:
            Error: no child can start, or the handler cannot be created.
        """
        while self._tasks or self._parked:
            outcome = None
            if not self._tasks:
                self._hand_out_parked()
            try:
                future = self._done.get(timeout=timeout_s)
            except queue.Empty:
                yield None
                continue
            if future in self._tasks:
                outcome = self._take(future)
            if outcome is not None:
                # At least one worker can do jobs.
                self._hand_out_parked()
                yield outcome

    def cancel(self) -> None:
        """End all jobs. Idempotent."""
        # Children, and the threads that wait for them, check for this file.
        (self._place / WORK).unlink(missing_ok=True)
        running = {future for future in self._tasks if not future.cancel()}
        self._tasks.clear()
        self._parked.clear()
        try:
            # This is for Slurm, whose jobs outlive their futures, and for Ray, whose
            # tasks may wait for others' resources.
            if end_run := getattr(self._engine, "end_run", None):
                end_run(str(self._place))
            wait(running)
        finally:
            # Clean up even if Ctrl-C interrupted the wait.
            end_idle_children(str(self._place))
            _remove(self._place)
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.cancel()

    def _hand_out(self, task: _Task) -> None:
        job = {"key": task.key, "arguments": dict(task.arguments)}
        future = self._engine.submit(do_job, str(self._place), job)
        self._tasks[future] = task
        future.add_done_callback(self._done.put)

    def _hand_out_parked(self) -> None:
        while self._parked:
            self._hand_out(self._parked.pop(0))

    def _take(self, future: Future[Any]) -> JobOutcome | None:
        """Return the outcome of a job, or None if it will be retried."""
        task = self._tasks.pop(future)
        try:
            answer = future.result()
        except CancelledError:
            answer = {"died": "was canceled by its executor", "begun": True}
        except Error:
            raise
        except Exception as error:
            # This error is from the executor itself, which has lost one of its workers.
            why = f"{type(error).__name__}: {error}".splitlines()
            how = f"is gone: {why[0]} {why[-1] if why[1:] else ''}"
            answer = {"died": how, "begun": True}
        self._log(answer.get("log", ()))
        if "error" in answer:
            raise unpacked(answer["error"])
        if "died" in answer:
            return self._bury(task, answer["died"], has_begun=answer["begun"])
        value, failure = answer.get("value"), answer.get("failure")
        return JobOutcome(key=task.key, value=value, failure=failure)

    def _bury(self, task: _Task, how: str, *, has_begun: bool) -> JobOutcome | None:
        can_any_begin = (self._place / BEGUN).exists()
        if not has_begun and can_any_begin and self._tasks:
            # The child never started the job, so the job waits for a working worker.
            logger.warning("A worker could not start. It %s", how)
            self._parked.append(task)
            return None
        task.deaths += 1
        if task.deaths < TRIES:
            logger.warning(
                "A worker died while doing the job %s, which will be retried. It %s",
                task.key,
                how,
            )
            self._hand_out(task)
            return None
        if not can_any_begin:
            raise Error(f"No worker can start. The last worker {how}")
        failure = f"Its worker died on try {task.deaths} of {TRIES}: it {how}"
        return JobOutcome(key=task.key, value=None, failure=failure)

    def _log(self, lines: Any) -> None:
        """Log the children's log records in this process, each message once per run."""
        for name, level, text in lines:
            # MuJoCo's warnings vary in times and joint numbers; log each kind only
            # once.
            kind = _NUMBERS.sub("", text) if name.endswith(_OF_MUJOCO) else text
            if (name, level, kind) not in self._told:
                self._told.add((name, level, kind))
                logging.getLogger(name).log(level, "%s", text)


def _new_place(shared: Path | None) -> Path:
    """Create a folder that the children can see, and return its path."""
    name = os.urandom(8).hex()
    try:
        if shared is None:
            place = _TEMPORARY / f"mjrec-work-{name}"
        else:
            place = shared.absolute() / WORK_FOLDER / name
            _end_earlier_runs(place.parent)
        # The folder determines what code runs, so only its owner may write to it.
        place.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise DirectoryNotWritable(shared or _TEMPORARY, error.strerror) from error
    return place


def _end_earlier_runs(folder: Path) -> None:
    """Remove the folders left by killed drivers, which ends those runs' children."""
    for path in folder.glob(f"*/{WORK}"):
        with contextlib.suppress(OSError), path.open("rb") as file:
            # This raises an error if the driver is running.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            logger.info("The run in %s has no driver, so it was stopped.", path.parent)
            path.unlink()
            _remove(path.parent)


def _remove(place: Path) -> None:
    shutil.rmtree(place, ignore_errors=True)
    if place.parent.name == WORK_FOLDER:
        with contextlib.suppress(OSError):
            place.parent.rmdir()

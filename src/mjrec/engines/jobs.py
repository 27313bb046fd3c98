# SPDX-License-Identifier: Apache-2.0
"""Handing jobs to an executor, and following them until all are over.

An engine is a `concurrent.futures.Executor`: ours (`LocalEngine`, `RayEngine`,
`SlurmEngine`) or any other whose workers see the same directory. What it is given is
`worker.do_job` with plain data, which does the job in a child process of the worker. So
a crash costs one job, and the executor never notices it.

Doing a job twice is harmless: a job whose child died is handed out again.
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

# In `Work.shared_directory`: what children need while a run lasts.
WORK_FOLDER = ".mjrec.work"

TRIES = 3

_OF_MUJOCO = "simulation.warnings"
_NUMBERS = re.compile(r"[\d.]+")

# Not by `tempfile`, which loads `random`: a script's neighbour may be called so.
_TEMPORARY = Path(os.environ.get("TMPDIR") or "/tmp")


@dataclass(frozen=True, kw_only=True)
class Work:
    """What the children of a run do.

    Attributes:
        entry: `module:name` of what makes a handler. It is called once in each child,
            with the settings. The handler is called with the arguments of one job
            after the other and returns a small JSON object. If it has `leave()`, that
            is called on another thread when the child is ended by no fault of its own.
        settings: for all jobs; JSON.
        environ: environment variables of the children, besides their worker's.
        shared_directory: one that all workers see under this name; a folder in it is
            used while the run lasts. None is enough for processes of this machine.
        payload: bytes for all children; the settings get their file as `payload`.
    """

    entry: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    environ: Mapping[str, str] = field(default_factory=dict)
    shared_directory: Path | None = None
    payload: bytes | None = None


@dataclass(frozen=True, kw_only=True)
class JobOutcome:
    """The end of a job.

    Attributes:
        key: of the job.
        value: what the handler returned; None where it failed.
        failure: what the handler raised, or how the child died; None where it did not.
        tries: how often it was begun.
    """

    key: str
    value: Mapping[str, Any] | None
    failure: str | None = None
    tries: int = 1


@dataclass
class _Task:
    key: str
    arguments: Mapping[str, Any]
    deaths: int = 0


class Run:
    """Jobs of one work on one executor. Leaving `with` cancels what is not done.

    Args:
        engine: where the jobs run. It is not shut down.
        work: what is done.

    Raises:
        InvalidArgument: the executor's workers may be on other machines and there is no
            shared directory.
        DirectoryNotWritable: that directory.
    """

    def __init__(self, engine: Executor, work: Work) -> None:
        self._engine = engine
        is_here = isinstance(engine, LocalEngine)
        if not is_here and work.shared_directory is None:
            raise InvalidArgument(
                "Workers elsewhere need a directory that all workers see, and this "
                "work names none (shared_directory)."
            )
        self._place = _new_place(None if is_here else work.shared_directory)
        settings = dict(work.settings)
        if work.payload is not None:
            settings["payload"] = str(self._place / "payload")
            (self._place / "payload").write_bytes(work.payload)
        share = getattr(engine, "share", None)
        # Locked while this process lives.
        self._file = (self._place / WORK).open("w")
        fcntl.flock(self._file, fcntl.LOCK_EX)
        json.dump(
            {
                "entry": work.entry,
                "settings": settings,
                "environ": dict(work.environ),
                "require_gpu": share.required if share and share.asked_for else None,
                # Modules of a policy are found where the driver finds them.
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

    @property
    def unfinished(self) -> int:
        """How many jobs have no outcome yet."""
        return len(self._tasks) + len(self._parked)

    def submit(self, key: str, **arguments: Any) -> None:
        """Add a job, also while results come.

        Args:
            key: tells it from all others of the run.
            **arguments: JSON.
        """
        self._hand_out(_Task(key, arguments))

    def results(self, *, timeout_s: float | None = None) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they come, until there is no job left.

        A job whose child dies is done again behind the others, `TRIES` times in all.

        Args:
            timeout_s: None is yielded whenever nothing has come for so long; never,
                if it is None.

        Raises:
            Error: no child can begin; or what the handler's maker raised.
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
                # There is a worker that can do jobs.
                self._hand_out_parked()
                yield outcome

    def cancel(self) -> None:
        """End all jobs. Idempotent."""
        # Children, and those who wait for them, see it.
        (self._place / WORK).unlink(missing_ok=True)
        running = {future for future in self._tasks if not future.cancel()}
        self._tasks.clear()
        self._parked.clear()
        try:
            # Slurm's, whose jobs outlive their futures.
            if end_run := getattr(self._engine, "end_run", None):
                end_run(str(self._place))
            wait(running)
        finally:
            # Also where Ctrl-C has cut the waiting short.
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
        """Return the outcome of a job; None where it is to be done again."""
        task = self._tasks.pop(future)
        try:
            answer = future.result()
        except CancelledError:
            answer = {"died": "was cancelled by its executor", "begun": True}
        except Error:
            raise
        except Exception as error:
            # The executor's own: a worker of it is gone.
            why = f"{type(error).__name__}: {error}".splitlines()
            how = f"is gone: {why[0]} {why[-1] if why[1:] else ''}"
            answer = {"died": how, "begun": True}
        self._log(answer.get("log", ()))
        if "error" in answer:
            raise unpacked(answer["error"])
        if "died" in answer:
            return self._bury(task, answer["died"], has_begun=answer["begun"])
        return JobOutcome(
            key=task.key,
            value=answer.get("value"),
            failure=answer.get("failure"),
            tries=task.deaths + 1,
        )

    def _bury(self, task: _Task, how: str, *, has_begun: bool) -> JobOutcome | None:
        can_any_begin = (self._place / BEGUN).exists()
        if not has_begun and can_any_begin and self._tasks:
            # It never came to the job, which waits for a worker that can do jobs.
            logger.warning("A worker could not begin. It %s", how)
            self._parked.append(task)
            return None
        task.deaths += 1
        if task.deaths < TRIES:
            logger.warning(
                "A worker died at the job %s, which is begun again. It %s",
                task.key,
                how,
            )
            self._hand_out(task)
            return None
        if not can_any_begin:
            raise Error(f"No worker can begin. The last one {how}")
        failure = f"Its worker died, which was try {task.deaths} of {TRIES}: it {how}"
        return JobOutcome(key=task.key, value=None, failure=failure, tries=task.deaths)

    def _log(self, lines: Any) -> None:
        """Log here what children logged, each text once in a run."""
        for name, level, text in lines:
            # What MuJoCo says of a moment or a joint is no other warning at the next.
            kind = _NUMBERS.sub("", text) if name.endswith(_OF_MUJOCO) else text
            if (name, level, kind) not in self._told:
                self._told.add((name, level, kind))
                logging.getLogger(name).log(level, "%s", text)


def _new_place(shared: Path | None) -> Path:
    """Return a new folder that children see."""
    name = os.urandom(8).hex()
    try:
        if shared is None:
            place = _TEMPORARY / f"mjrec-work-{name}"
        else:
            place = shared.absolute() / WORK_FOLDER / name
            _end_earlier_runs(place.parent)
        # Only its owner says what is run.
        place.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise DirectoryNotWritable(shared or _TEMPORARY, error.strerror) from error
    return place


def _end_earlier_runs(folder: Path) -> None:
    """Remove the folders of killed drivers, which ends what still works for them."""
    for path in folder.glob(f"*/{WORK}"):
        with contextlib.suppress(OSError), path.open("rb") as file:
            # Raises where the driver lives.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            logger.info("The run in %s has no driver, and is ended.", path.parent)
            path.unlink()
            _remove(path.parent)


def _remove(place: Path) -> None:
    shutil.rmtree(place, ignore_errors=True)
    if place.parent.name == WORK_FOLDER:
        with contextlib.suppress(OSError):
            place.parent.rmdir()

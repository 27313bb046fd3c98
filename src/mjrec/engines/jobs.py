# SPDX-License-Identifier: Apache-2.0
"""Handing jobs to an executor, and following them until all are over.

An engine is a `concurrent.futures.Executor`: ours (`LocalEngine`, `RayEngine`,
`SlurmEngine`) or any other whose workers see the same directory. What it is given is
`worker.do_job` with plain data, which does the job in a child process of the worker. So
a crash costs one job, and the executor never notices it.

Doing a job twice is harmless: a job whose child died is handed out again.
"""

from __future__ import annotations

import collections
import contextlib
import json
import logging
import os
import shutil
import sys
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..errors import ClosedError, DirectoryNotWritable, Error, InvalidArgument
from ..messages import unpacked
from .local import LocalEngine
from .worker import STOP, do_job, end_idle_children

logger = logging.getLogger(__name__)

# In `Work.shared_directory`: what children need while a run lasts.
WORK_FOLDER = ".mjrec.work"

TRIES = 3

# Not by `tempfile`, which loads `random`: a script's neighbour may be called so.
_TEMPORARY = Path(os.environ.get("TMPDIR") or "/tmp")


@dataclass(frozen=True, kw_only=True)
class Work:
    """What the children of a run do.

    Attributes:
        entry: `module:name` of what makes a handler. It is called once in each child,
            with the settings. The handler is called with the arguments of one job
            after the other and returns a small JSON object; its `close()` lets go of
            what it holds.
        settings: for all jobs; JSON.
        environ: environment variables of the children, besides their worker's.
        shared_directory: one that all workers see under this name; a folder in it is
            used while the run lasts. None is enough for processes of this machine.
    """

    entry: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    environ: Mapping[str, str] = field(default_factory=dict)
    shared_directory: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Job:
    """A piece of work. Doing it twice is doing it once.

    Attributes:
        key: tells it from all others of its run.
        arguments: JSON.
    """

    key: str
    arguments: Mapping[str, Any]


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
    job: Job
    deaths: int = 0


class Run:
    """Jobs of one work on one executor. Leaving `with` cancels what is not done.

    For one thread at a time, in the process that made it.

    Args:
        engine: where the jobs run. It is not shut down.
        work: what is done.

    Raises:
        InvalidArgument: the settings are no JSON, or the executor's workers may be on
            other machines and there is no shared directory.
        DirectoryNotWritable: that directory.
    """

    def __init__(self, engine: Executor, work: Work) -> None:
        self.engine = engine
        _check_json(dict(work.settings), "The settings of the work")
        is_here = isinstance(engine, LocalEngine)
        if not is_here and work.shared_directory is None:
            raise InvalidArgument(
                "Workers elsewhere need a directory that all workers see, and this "
                "work names none (shared_directory)."
            )
        shared = None if is_here else work.shared_directory
        is_new = shared is not None and not shared.exists()
        self._place = _new_place(shared)
        self._work = {
            "entry": work.entry,
            "settings": dict(work.settings),
            "environ": dict(work.environ),
            "place": str(self._place),
            "require_gpu": getattr(engine, "require_gpu", None),
            # Modules of a policy are found where the driver finds them.
            "directory": str(Path.cwd()),
            "path": [str(Path(entry).absolute()) for entry in sys.path],
        }
        self._keys: set[str] = set()
        self._waiting: collections.deque[_Task] = collections.deque()
        self._tasks: dict[Future[Any], _Task] = {}
        self._told: set[tuple[str, int, str]] = set()
        self._any_is_done = False
        self._owner = os.getpid()
        self._leave = weakref.finalize(
            self,
            _leave,
            self._place,
            self._owner,
            is_new=is_new,
            # Slurm's, whose jobs outlive their futures.
            end_run=getattr(engine, "end_run", None),
        )

    @property
    def workers(self) -> int | None:
        """How many jobs the executor does at once; None where it does not say."""
        return getattr(self.engine, "workers", None)

    @property
    def unfinished(self) -> int:
        """How many jobs have no outcome yet."""
        return len(self._waiting) + len(self._tasks)

    def submit(self, job: Job) -> None:
        """Add a job, also while results come.

        Raises:
            InvalidArgument: there was one with that key, or its arguments are no JSON.
            ClosedError: the run is cancelled, or another process's.
        """
        self._check_usable()
        if job.key in self._keys:
            raise InvalidArgument(f"There was a job {job.key!r} in this run already.")
        _check_json(dict(job.arguments), f"The arguments of the job {job.key!r}")
        self._keys.add(job.key)
        self._waiting.append(_Task(job))

    def results(
        self, *, patience_s: float | None = None
    ) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they come, until there is no job left or all is cancelled.

        A job whose child dies is done again behind the others, `TRIES` times in all.

        Args:
            patience_s: None is yielded whenever nothing has come for so long; never,
                if it is None.

        Raises:
            InvalidArgument: `patience_s` is no positive number.
            ClosedError: the run is cancelled, or another process's.
            Error: no child can begin; or what the handler's maker raised.
        """
        return results_of(self, patience_s=patience_s)

    def cancel(self) -> None:
        """End all jobs; those at work may close their files. Idempotent."""
        if os.getpid() != self._owner or not self._leave.alive:
            return
        _stop(self._place)
        running = {future for future in self._tasks if not future.cancel()}
        self._tasks.clear()
        try:
            wait(running)
        finally:
            # Also where Ctrl-C has cut the waiting short.
            end_idle_children(str(self._place))
            self._leave()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.cancel()

    def _hand_out(self) -> None:
        while self._waiting and self._leave.alive:
            task = self._waiting.popleft()
            message = {
                "work": self._work,
                "key": task.job.key,
                "arguments": dict(task.job.arguments),
            }
            self._tasks[self.engine.submit(do_job, message)] = task

    def _take(self, future: Future[Any]) -> JobOutcome | None:
        """Return the outcome of a job; None where it is to be done again."""
        task = self._tasks.pop(future)
        try:
            said = future.result()
        except CancelledError:
            said = {"died": "was cancelled by its executor"}
        except Exception as error:
            # The executor's own: a worker of it is gone.
            if isinstance(error, Error):
                raise
            why = f"{type(error).__name__}: {error}".splitlines()
            said = {"died": f"is gone: {why[0]} {why[-1] if why[1:] else ''}"}
            said["begun"] = False
        self._log(said.get("log", ()))
        if "error" in said:
            raise unpacked(said["error"])
        if "died" in said:
            return self._bury(task, said["died"], has_begun=said.get("begun", True))
        self._any_is_done = True
        return JobOutcome(
            key=task.job.key,
            value=said.get("value"),
            failure=said.get("failure"),
            tries=task.deaths + 1,
        )

    def _bury(self, task: _Task, how: str, *, has_begun: bool) -> JobOutcome | None:
        task.deaths += 1
        if task.deaths < TRIES:
            logger.warning(
                "A worker died at the job %s, which is begun again. It %s",
                task.job.key,
                how,
            )
            self._waiting.append(task)
            return None
        if not has_begun and not self._any_is_done:
            raise Error(f"No worker can begin. The last one {how}")
        failure = f"Its worker died, which was try {task.deaths} of {TRIES}: it {how}"
        return JobOutcome(
            key=task.job.key, value=None, failure=failure, tries=task.deaths
        )

    def _log(self, lines: Any) -> None:
        """Log here what children logged, each text once in a run."""
        for name, level, text in lines:
            if (name, level, text) not in self._told:
                self._told.add((name, level, text))
                logging.getLogger(name).log(level, "%s", text)

    def _check_usable(self) -> None:
        if os.getpid() != self._owner:
            raise ClosedError(
                f"The run belongs to process {self._owner}: begin one in the process "
                "that uses it."
            )
        if not self._leave.alive:
            raise ClosedError("The run is cancelled.")


def results_of(
    *runs: Run, patience_s: float | None = None
) -> Iterator[JobOutcome | None]:
    """Yield the outcomes of several runs as they come; see `Run.results`."""
    for run in runs:
        run._check_usable()
    if patience_s is not None and not patience_s > 0:
        raise InvalidArgument(
            f"patience_s must be a positive number of seconds, got {patience_s!r}."
        )
    return _results_of(set(runs), patience_s)


def _results_of(
    runs: Iterable[Run], patience_s: float | None
) -> Iterator[JobOutcome | None]:
    last = time.monotonic()
    while True:
        for run in runs:
            run._hand_out()
        futures = {future: run for run in runs for future in run._tasks}
        if not futures:
            return
        rest = None if patience_s is None else last + patience_s - time.monotonic()
        seconds = None if rest is None else max(0.0, rest)
        done, _ = wait(futures, seconds, return_when=FIRST_COMPLETED)
        outcomes = [futures[future]._take(future) for future in done]
        for run in runs:
            # The workers shall not wait for the caller.
            run._hand_out()
        for outcome in outcomes:
            if outcome is not None:
                yield outcome
                last = time.monotonic()
        if not done:
            yield None
            last = time.monotonic()


def _new_place(shared: Path | None) -> Path:
    """Return a new folder that children see."""
    name = os.urandom(8).hex()
    try:
        if shared is None:
            place = _TEMPORARY / f"mjrec-work-{name}"
        else:
            place = shared.absolute() / WORK_FOLDER / name
            place.parent.mkdir(parents=True, exist_ok=True)
        # Only its owner says what is run.
        place.mkdir(mode=0o700)
    except OSError as error:
        raise DirectoryNotWritable(shared or _TEMPORARY, error.strerror) from error
    return place


def _stop(place: Path) -> None:
    with contextlib.suppress(OSError):
        (place / STOP).touch()


def _leave(
    place: Path, owner: int, *, is_new: bool, end_run: Callable[[str], None] | None
) -> None:
    # A forked child's copy; the run is its parent's.
    if os.getpid() != owner:
        return
    _stop(place)
    if end_run is not None:
        end_run(str(place))
    shutil.rmtree(place, ignore_errors=True)
    if place.parent.name == WORK_FOLDER:
        # What a run had to make goes with it, where nothing else is there.
        with contextlib.suppress(OSError):
            place.parent.rmdir()
            if is_new:
                place.parent.parent.rmdir()


def _check_json(said: Mapping[str, Any], what: str) -> None:
    try:
        json.dumps(said)
    except (TypeError, ValueError) as error:
        raise InvalidArgument(f"{what} cannot be written as JSON: {error}.") from error

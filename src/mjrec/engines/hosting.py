# SPDX-License-Identifier: Apache-2.0
"""Doing jobs on this machine for a run whose driver is on another one.

Whatever brings work to a machine (a Ray task, a Slurm job) holds a `Host` there, which
does it in processes of that machine, as the local engine does: what a policy breaks,
prints or hangs in, and how a process ends, is the same everywhere. Home come lines of
JSON, one for each job::

    {"key": "a", "value": {...}, "tries": 1, "log": [...]}
    {"key": "b", "failure": "...", "tries": 3, "log": [...]}
    {"error": {...}, "log": [...]}        no worker can begin here

`log` is what was logged as a warning or worse since the last line.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..child_python import carried, said_in, unpacked
from ..errors import Error
from .gpu_shares import GpuShare
from .home_log import HomeLog
from .job_book import JobBook, Task, as_json
from .local import LocalRun
from .work import Job, JobOutcome, Work


@dataclass(frozen=True, kw_only=True)
class HostedWork:
    """Work on its way to hosts, but for its payload, which is large.

    Attributes:
        work: without its payload.
        share: what each worker gets of GPUs.
        directory: the driver's working directory.
        path: the driver's module search path.
    """

    work: Work
    share: GpuShare
    directory: str
    path: tuple[str, ...]

    @classmethod
    def of(cls, work: Work, share: GpuShare) -> Self:
        """Return the work of a driver that is this process."""
        return cls(
            work=dataclasses.replace(work, payload=None),
            share=share,
            directory=str(Path.cwd()),
            path=tuple(str(Path(entry).absolute()) for entry in sys.path),
        )

    def to_json(self) -> bytes:
        """Return it in one line.

        Raises:
            InvalidArgument: the settings are no JSON.
        """
        facts = {
            "entry": self.work.entry,
            "settings": dict(self.work.settings),
            "environ": dict(self.work.environ),
            "gpus": self.share.each,
            "require_gpu": self.share.required,
            "directory": self.directory,
            "path": self.path,
        }
        return as_json(facts, what="The settings of the work")

    @classmethod
    def from_json(cls, line: bytes) -> Self:
        """Return what `to_json` wrote."""
        facts = json.loads(line)
        return cls(
            work=Work(
                entry=facts["entry"],
                settings=facts["settings"],
                environ=facts["environ"],
            ),
            share=GpuShare(each=facts["gpus"], required=facts["require_gpu"]),
            directory=facts["directory"],
            path=tuple(facts["path"]),
        )


class Host:
    """Does jobs of a run in processes of this machine, until it is closed.

    They are where the driver is, and find its modules, on machines that have those
    directories; what this machine has of its own comes first. For one thread at a time.

    Args:
        hosted: the work.
        payload: of it.
        workers: how many processes.
        gpus: those that this part of the run was given, as `CUDA_VISIBLE_DEVICES` names
            them.

    Raises:
        Error: the system grants no memory for the payload.
    """

    def __init__(
        self,
        hosted: HostedWork,
        payload: bytes | None,
        *,
        workers: int = 1,
        gpus: Sequence[str] = (),
    ) -> None:
        directory = Path(hosted.directory)
        known = set(sys.path)
        sys.path += [
            entry
            for entry in hosted.path
            if entry not in known and Path(entry).exists()
        ]
        self._log = _KeptLog()
        self._run = LocalRun(
            dataclasses.replace(hosted.work, payload=payload),
            workers,
            share=hosted.share,
            gpus=gpus,
            directory=directory if directory.is_dir() else None,
        )
        logging.getLogger().addHandler(self._log)

    def submit(self, line: bytes) -> None:
        """Take a job, as `job_book.Task` has it.

        Raises:
            InvalidArgument: it had that job before.
            ClosedError: it is closed.
        """
        self._run.submit(Job(**json.loads(line)))

    @property
    def unfinished(self) -> int:
        """How many jobs it has that are not over."""
        return self._run.unfinished

    def lines(self, *, patience_s: float | None = None) -> Iterator[bytes | None]:
        """Yield what is to go home, until there is no job left.

        Args:
            patience_s: None is yielded whenever there has been nothing for so long.
        """
        try:
            for outcome in self._run.results(patience_s=patience_s):
                yield None if outcome is None else self._said(**_facts(outcome))
        except Error as error:
            yield self._said(error=carried(error))

    def close(self) -> None:
        """End the workers; what they are at may close its files. Idempotent."""
        logging.getLogger().removeHandler(self._log)
        self._run.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _said(self, **facts: Any) -> bytes:
        return json.dumps({**facts, "log": self._log.take()}).encode()


def take_home(line: bytes, task: Task, book: JobBook, log: HomeLog) -> None:
    """Note in the driver what a host has sent home of a job.

    Where no worker could begin, that is the run's error, unless others have begun: then
    it may be that machine's, and the job is begun again.

    Args:
        line: that it has sent.
        task: the job.
        book: of the run.
        log: of the run.

    Raises:
        Error: what stands in the way of any worker, as it was raised there.
    """
    said = said_in(line)
    log.tell(said.get("log", ()))
    if "error" not in said:
        book.finish(
            task,
            value=said.get("value"),
            failure=said.get("failure"),
            tries=said.get("tries", 1),
        )
    elif book.any_is_done:
        book.begin_again(task, f"could not begin: {unpacked(said['error'])}")
    else:
        raise unpacked(said["error"])


def _facts(outcome: JobOutcome) -> dict[str, Any]:
    facts = dataclasses.asdict(outcome)
    return {name: fact for name, fact in facts.items() if fact is not None}


class _KeptLog(logging.Handler):
    """Keeps what is worth a warning until it goes home."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._lines: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._lines.append((record.name, record.levelno, record.getMessage()))
        except Exception:
            # As all handlers: who logs is not disturbed by it.
            self.handleError(record)

    def take(self) -> list[tuple[str, int, str]]:
        """Return what there is, and forget it."""
        taken, self._lines = self._lines, []
        return taken

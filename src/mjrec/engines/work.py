# SPDX-License-Identifier: Apache-2.0
"""Work that is handed out to processes, and what comes back.

The interface is small on purpose, so that an engine is one file: jobs are submitted,
outcomes come back as they come, and what is not done can be cancelled. What travels is
JSON, and one payload that each worker is given once; what is large lies in files that
all workers see. Nothing here knows what the work is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

# In `Work.shared_directory`: where an engine keeps what it needs while work is done.
WORK_FOLDER = ".mjrec.work"

# What engines add to the arguments of a job that somebody has begun before.
AGAIN = "again"


@dataclass(frozen=True, kw_only=True)
class Work:
    """What the workers of a run do.

    Attributes:
        entry: `module:name` of what makes a `Handler`: it is called once in each
            worker, with the settings and the payload.
        settings: for all of its jobs; JSON.
        payload: bytes that each worker is given once, such as a policy; None for none.
        environ: environment variables of the workers, besides those of this process.
        shared_directory: one that all workers see, wherever they are, and this process
            too; an engine may keep what it needs in a folder of it, and removes that
            at the end. None where there is none. It need not be there yet.
    """

    entry: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    payload: bytes | None = None
    environ: Mapping[str, str] = field(default_factory=dict)
    shared_directory: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Job:
    """A piece of work, which can be done again: doing it twice is doing it once.

    Attributes:
        key: tells it from all others of its run.
        arguments: JSON. Where a worker has begun the job before, the next one is given
            `AGAIN` with true besides.
    """

    key: str
    arguments: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class JobOutcome:
    """What became of a job.

    Attributes:
        key: of the job.
        value: what the handler returned, JSON; None where it failed.
        failure: why there is no value: what the handler raised, or how the worker
            died. None where there is one.
        tries: how often it was begun.
    """

    key: str
    value: Mapping[str, Any] | None
    failure: str | None = None
    tries: int = 1


class Handler(Protocol):
    """Does the jobs of one worker, one after the other."""

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job and return a small JSON object."""

    def close(self) -> None:
        """Let go of what is held between jobs; there are no more of them."""


class Run(Protocol):
    """Work that has been begun. Leaving `with` cancels what is not done."""

    @property
    def workers(self) -> int:
        """How many jobs are done at once, at most, as far as that is known."""

    def submit(self, job: Job) -> None:
        """Hand out a job; also while results come.

        Raises:
            InvalidArgument: there was one with that key.
        """

    @property
    def unfinished(self) -> int:
        """How many jobs have been submitted whose outcome has not been given out."""

    def results(
        self, *, patience_s: float | None = None
    ) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they come, until none is outstanding.

        A job whose worker died is begun again, in a new worker, before that is its
        outcome.

        Args:
            patience_s: None is yielded whenever nothing has come for so long; never,
                if it is None.

        Raises:
            Error: no worker can be started, or each ends as soon as it begins.
        """

    def cancel(self) -> None:
        """End all workers; jobs that are not done stay so. Idempotent.

        Workers are told to end (SIGTERM), so that what they are at can close its
        files, and are killed where they have not done so after some seconds.
        """

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


class Engine(Protocol):
    """A place where work runs."""

    def begin(self, work: Work) -> Run:
        """Begin a run. Workers are started when there are jobs."""

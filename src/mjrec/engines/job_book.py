# SPDX-License-Identifier: Apache-2.0
"""The jobs of a run, from being submitted to their outcomes."""

from __future__ import annotations

import collections
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InvalidArgument
from .work import AGAIN, Job, JobOutcome

logger = logging.getLogger(__name__)

# Once may be chance, such as the system's killer of processes that need much memory;
# so may twice, on a machine that has too little of it. Three times is the job.
TRIES = 3


@dataclass(eq=False)
class Task:
    """A job that has no outcome yet.

    Attributes:
        job: which one.
        line: the job as JSON, `{"key": ..., "arguments": ...}`.
        deaths: how many workers have died at it, by whatever it did.
    """

    job: Job
    line: bytes
    deaths: int = 0

    @property
    def key(self) -> str:
        """The job's."""
        return self.job.key


class JobBook:
    """Knows of each job of a run whether it waits, is being done, or is over."""

    def __init__(self) -> None:
        self._keys: set[str] = set()
        self._given_out = 0
        self._waiting: collections.deque[Task] = collections.deque()
        self._outcomes: collections.deque[JobOutcome] = collections.deque()
        self._any_is_done = False

    @property
    def unfinished(self) -> int:
        """How many jobs there are whose outcome has not been given out."""
        return len(self._keys) - self._given_out

    @property
    def waiting(self) -> int:
        """How many jobs nobody has begun."""
        return len(self._waiting)

    def add(self, job: Job) -> None:
        """Note a job that waits.

        Raises:
            InvalidArgument: there was one with that key, or its arguments are no JSON.
        """
        if job.key in self._keys:
            raise InvalidArgument(f"There was a job {job.key!r} in this run already.")
        line = as_json(
            {"key": job.key, "arguments": dict(job.arguments)},
            what=f"The arguments of the job {job.key!r}",
        )
        self._keys.add(job.key)
        self._waiting.append(Task(job, line))

    def take(self) -> Task:
        """Return the job that has waited longest, which somebody now does."""
        return self._waiting.popleft()

    @property
    def any_is_done(self) -> bool:
        """Whether a handler has done any job, successfully or not."""
        return self._any_is_done

    def finish(
        self,
        task: Task,
        *,
        value: Mapping[str, Any] | None,
        failure: str | None = None,
        tries: int = 1,
    ) -> None:
        """Note what became of a job.

        Args:
            task: which one.
            value: what the handler returned.
            failure: why there is no value.
            tries: how often it was begun, besides those at which workers died.
        """
        self._any_is_done = self._any_is_done or tries > 0
        self._outcomes.append(
            JobOutcome(
                key=task.key, value=value, failure=failure, tries=task.deaths + tries
            )
        )

    def begin_again(self, task: Task, how: str) -> None:
        """Put a job whose worker has died behind the others, or give it up.

        Args:
            task: which one.
            how: the worker died, as a part of a sentence.
        """
        task.deaths += 1
        if task.deaths < TRIES:
            logger.warning(
                "A worker died at the job %s, which is begun again. It %s",
                task.key,
                how,
            )
            self._waiting.append(_again(task))
            return
        failure = f"Its worker died, which was try {task.deaths} of {TRIES}: it {how}"
        self.finish(task, value=None, failure=failure, tries=0)

    def put_back(self, task: Task) -> None:
        """Let a job be done first of all: through no fault of its own it was not."""
        self._waiting.appendleft(_again(task))

    def next_outcome(self) -> JobOutcome | None:
        """Return an outcome that is given out now; None where there is none."""
        if not self._outcomes:
            return None
        self._given_out += 1
        return self._outcomes.popleft()

    @property
    def has_outcome(self) -> bool:
        """Whether there is an outcome to give out."""
        return bool(self._outcomes)


def _again(task: Task) -> Task:
    """Let a job say that somebody has begun it before."""
    arguments = {**task.job.arguments, AGAIN: True}
    task.line = json.dumps({"key": task.key, "arguments": arguments}).encode()
    return task


def as_json(said: Mapping[str, Any], *, what: str) -> bytes:
    """Return a JSON object in one line.

    Raises:
        InvalidArgument: it is none; the message calls it `what`.
    """
    try:
        return json.dumps(said).encode()
    except (TypeError, ValueError) as error:
        raise InvalidArgument(f"{what} cannot be written as JSON: {error}.") from error

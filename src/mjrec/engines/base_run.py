# SPDX-License-Identifier: Apache-2.0
"""What the runs of all engines have in common."""

from __future__ import annotations

import abc
import os
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from ..errors import ClosedError, InvalidArgument
from .job_book import JobBook
from .work import Job, JobOutcome


class BaseRun(abc.ABC):
    """Work that has been begun, whose jobs are in a book; a `work.Run`.

    For one thread at a time, and for the process that began it. An engine says what a
    turn of its own is, how all ends, and how many workers there are.
    """

    def __init__(self) -> None:
        self._book = JobBook()
        self._cancelled = False
        self._process_id = os.getpid()

    @property
    @abc.abstractmethod
    def workers(self) -> int:
        """How many jobs are done at once, at most, as far as that is known."""

    @abc.abstractmethod
    def _turn(self, seconds: float | None) -> None:
        """Hand out jobs, and note what has come of some, waiting so long for news.

        Args:
            seconds: the longest wait; None is until there is some, or for a moment.
        """

    @abc.abstractmethod
    def _end(self) -> None:
        """End all workers and let go of everything; it is called once."""

    def submit(self, job: Job) -> None:
        """Hand out a job; also while results come.

        Raises:
            InvalidArgument: there was one with that key, or its arguments are no JSON.
            ClosedError: the run is cancelled, or another process's.
        """
        self._check_usable()
        self._book.add(job)

    @property
    def unfinished(self) -> int:
        """How many jobs have been submitted whose outcome has not been given out."""
        return self._book.unfinished

    def results(
        self, *, patience_s: float | None = None
    ) -> Iterator[JobOutcome | None]:
        """Yield outcomes as they come, until none is outstanding or all is cancelled.

        Args:
            patience_s: None is yielded whenever no outcome has come for so long; never,
                if it is None.

        Raises:
            InvalidArgument: `patience_s` is no positive number.
            ClosedError: the run is cancelled, or another process's.
            Error: no worker can be started, each ends as soon as it begins, or what
                makes the handler raised. What it raised, if that is one of ours.
        """
        self._check_usable()
        if patience_s is not None and not patience_s > 0:
            raise InvalidArgument(
                f"patience_s must be a positive number of seconds, got {patience_s!r}."
            )
        return self._results(patience_s)

    def cancel(self) -> None:
        """End all workers; jobs that are not done stay so. Idempotent.

        Workers are told to end, so that what they are at can close its files, and are
        killed where they have not done so after some seconds.
        """
        if self._cancelled or os.getpid() != self._process_id:
            return
        self._cancelled = True
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.cancel()

    def _check_usable(self) -> None:
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The run belongs to process {self._process_id}: begin one in the "
                "process that uses it."
            )
        if self._cancelled:
            raise ClosedError("The run is cancelled.")

    def _results(self, patience_s: float | None) -> Iterator[JobOutcome | None]:
        last = time.monotonic()
        while self.unfinished and not self._cancelled:
            rest = None if patience_s is None else last + patience_s - time.monotonic()
            is_over = rest is not None and rest <= 0
            # Also where there are outcomes: the workers shall not wait for the caller.
            self._turn(0 if self._book.has_outcome or is_over else rest)
            outcome = self._book.next_outcome()
            if outcome is not None:
                yield outcome
            elif is_over:
                yield None
            else:
                continue
            last = time.monotonic()

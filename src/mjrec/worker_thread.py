# SPDX-License-Identifier: Apache-2.0
"""One background thread behind a bounded queue."""

from __future__ import annotations

import collections
import os
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from .errors import ClosedError

__all__ = ["WorkerThread"]

T = TypeVar("T")


class WorkerThread(Generic[T]):
    """Hands items, in order, to one function on one thread of its own.

    The queue is bounded: `put` waits for room and never drops an item. What the
    function raises comes home: the same exception is raised in the caller's thread.
    The thread is a daemon, so that it never keeps the interpreter from ending; only
    `close` promises that every item was consumed.

    Args:
        consume: called with each item, always on the same thread.
        capacity: how many items may wait.
        name: the thread's name, seen in debuggers.
        finish: called on the thread after the last item; not after an error or
            `abort`.
    """

    def __init__(
        self,
        consume: Callable[[T], None],
        *,
        capacity: int,
        name: str,
        finish: Callable[[], None] | None = None,
    ) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}.")
        self._consume = consume
        self._finish = finish
        self._capacity = capacity
        self._waiting: collections.deque[T] = collections.deque()
        # Condition's own lock is reentrant: a garbage collection while the thread
        # holds it may run a finaliser that calls `leave`.
        self._changed = threading.Condition()
        self._closing = False
        self._aborted = False
        self._error: BaseException | None = None
        self._error_was_raised = False
        self._process_id = os.getpid()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether the function has raised; no further item will be consumed."""
        return self._error is not None

    def put(self, item: T) -> None:
        """Queue `item`, waiting for room if need be.

        Raises:
            ClosedError: after `close`, `leave` or `abort`, or in a forked child, which
                has no copy of the thread.
            BaseException: whatever the function raised for an earlier item.
        """
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"{self._thread.name} lives in process {self._process_id} and cannot "
                "be used after a fork: make it in the process that uses it."
            )
        with self._changed:
            self._changed.wait_for(self._has_room_or_ended)
            self._raise_error()
            if self._closing:
                raise ClosedError(f"{self._thread.name} is closed.")
            self._waiting.append(item)
            self._changed.notify_all()

    def close(self) -> None:
        """Wait until every item is consumed and the thread has ended.

        May be called again, also after it was interrupted.

        Raises:
            BaseException: whatever the function raised, unless `put` or an earlier
                `close` has raised it already.
        """
        self.leave()
        self._join()
        if not self._error_was_raised:
            self._raise_error()

    def leave(self) -> None:
        """Let the thread consume what waits and end by itself. Never blocks."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def abort(self) -> None:
        """Drop what waits, wait for the item in hand, end the thread; raise nothing.

        Idempotent. Whatever the function may be blocked on has to be released first.
        """
        with self._changed:
            self._closing = True
            self._aborted = True
            self._waiting.clear()
            self._changed.notify_all()
        self._join()

    def _join(self) -> None:
        # A forked child has no such thread to wait for.
        if os.getpid() == self._process_id:
            self._thread.join()

    def _has_room_or_ended(self) -> bool:
        return self._closing or self.failed or len(self._waiting) < self._capacity

    def _raise_error(self) -> None:
        if self._error is not None:
            self._error_was_raised = True
            raise self._error

    def _run(self) -> None:
        try:
            while self._wait_for_item():
                self._consume(self._take())
            if self._finish is not None and not self._aborted:
                self._finish()
        # Whatever it is, it belongs to the caller; nobody looks at this thread.
        except BaseException as error:
            with self._changed:
                self._error = error
                self._waiting.clear()
                self._changed.notify_all()

    def _wait_for_item(self) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: self._closing or bool(self._waiting))
            return bool(self._waiting)

    def _take(self) -> T:
        with self._changed:
            item = self._waiting.popleft()
            self._changed.notify_all()
            return item

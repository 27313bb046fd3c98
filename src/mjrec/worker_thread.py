# SPDX-License-Identifier: Apache-2.0
"""One background thread behind a bounded queue."""

from __future__ import annotations

import collections
import os
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from .errors import ClosedError

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
        name: what the thread is for. Its name is this behind `mjrec-`.
        finish: called on the thread after the last item; not after an error or
            `abort`.

    Raises:
        RuntimeError: no thread can be started (beyond the system's limit).
    """

    def __init__(
        self,
        consume: Callable[[T], None],
        *,
        capacity: int,
        name: str,
        finish: Callable[[], None] | None = None,
    ) -> None:
        self._consume = consume
        self._finish = finish
        self._capacity = capacity
        self._name = name
        self._waiting: collections.deque[T] = collections.deque()
        # Reentrant: a garbage collection while the thread holds it may run a finaliser
        # that calls `leave`. Taken by itself, not through the condition, whose
        # `__enter__` is Python: Ctrl-C at its end would leave it locked.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._closing = False
        self._aborted = False
        self._error: BaseException | None = None
        self._error_was_raised = False
        self._process_id = os.getpid()
        # Waited for before the thread is: Python 3.11 and 3.12 take a thread for ended
        # when Ctrl-C interrupts `Thread.join`.
        self._has_ended = threading.Event()
        self._thread = threading.Thread(
            target=self._work, name=f"mjrec-{name}", daemon=True
        )
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
                f"{self._name} lives in process {self._process_id} and cannot be used "
                "after a fork: make it in the process that uses it."
            )
        with self._lock:
            self._changed.wait_for(self._has_room_or_ended)
            self._raise_error()
            if self._closing:
                raise ClosedError(f"{self._name} is closed.")
            self._waiting.append(item)
            self._changed.notify_all()

    def close(self) -> None:
        """Wait until every item is consumed and the thread has ended.

        May be called again, also after it was interrupted. Called on the thread itself,
        as by a finaliser during a garbage collection there, it is `leave`.

        Raises:
            BaseException: whatever the function raised, unless `put` or an earlier
                `close` has raised it already.
        """
        self.leave()
        self._wait_for_end()
        if not self._error_was_raised:
            self._raise_error()

    def leave(self) -> None:
        """Let the thread consume what waits and end by itself. Never blocks."""
        with self._lock:
            self._closing = True
            self._changed.notify_all()

    def abort(self) -> None:
        """Drop what waits, wait for the item in hand, end the thread; raise nothing.

        Idempotent. Whatever the function may be blocked on has to be released first.
        Called on the thread itself it does not wait.
        """
        with self._lock:
            self._aborted = True
            self._waiting.clear()
        self.leave()
        self._wait_for_end()

    def _wait_for_end(self) -> None:
        # Neither waits for itself; and a forked child has no such thread.
        is_own = self._thread is threading.current_thread()
        if not is_own and os.getpid() == self._process_id:
            self._has_ended.wait()
            self._thread.join()

    def _has_room_or_ended(self) -> bool:
        return self._closing or self.failed or len(self._waiting) < self._capacity

    def _raise_error(self) -> None:
        if self._error is not None:
            self._error_was_raised = True
            raise self._error

    def _work(self) -> None:
        try:
            while (item := self._next()) is not None:
                self._consume(item[0])
            if self._finish is not None and not self._aborted:
                self._finish()
        # Every error belongs to the caller; this thread has no reader.
        except BaseException as error:
            with self._lock:
                self._error = error
                self._waiting.clear()
                self._changed.notify_all()
        finally:
            self._has_ended.set()

    def _next(self) -> tuple[T] | None:
        """Wait for the next item; None once there will be none."""
        with self._lock:
            self._changed.wait_for(lambda: self._closing or bool(self._waiting))
            if not self._waiting:
                return None
            item = self._waiting.popleft()
            self._changed.notify_all()
            return (item,)

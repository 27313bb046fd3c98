# SPDX-License-Identifier: Apache-2.0
"""A background thread with a bounded queue."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from .errors import ClosedError

T = TypeVar("T")


class WorkerThread(Generic[T]):
    """A background thread that passes items to a function, in order.

    The queue is bounded: `put` waits for room and never drops an item. An exception in
    the function is raised again in the caller's thread. The thread is a daemon, so it
    never keeps the interpreter from exiting. Only `close` guarantees that all items
    were consumed.

    Args:
        consume: called with each item, always on the same thread.
        capacity: maximum number of waiting items.
        name: the thread's purpose; the thread's name is this with the prefix `mjrec-`.
        finish: called on the thread after the last item, but not after an error or
            `abort`.

    Raises:
        RuntimeError: the thread cannot be started (the system's limit is reached).
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
        self._name = name
        # These queues are reentrant: a finalizer that runs in the middle of a call may
        # call `leave`, and Ctrl-C leaves no lock held.
        self._waiting: queue.SimpleQueue[tuple[T] | None] = queue.SimpleQueue()
        self._room: queue.SimpleQueue[None] = queue.SimpleQueue()
        for _ in range(capacity):
            self._room.put(None)
        self._closing = False
        self._aborted = False
        self._error: BaseException | None = None
        self._error_was_raised = False
        self._process_id = os.getpid()
        # Waited for before `Thread.join`, because Python 3.11 and 3.12 consider a
        # thread ended if Ctrl-C interrupts `join`.
        self._has_ended = threading.Event()
        self._thread = threading.Thread(
            target=self._work, name=f"mjrec-{name}", daemon=True
        )
        self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether the function has raised an error. No more items are consumed then."""
        return self._error is not None

    def put(self, item: T) -> None:
        """Queue `item`, waiting for room if necessary.

        Raises:
            ClosedError: after `close`, `leave` or `abort`, or in a forked child, which
                has no copy of the thread.
            BaseException: the exception that the function raised for an earlier item.
        """
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"{self._name} belongs to process {self._process_id} and cannot be "
                "used after a fork: create it in the process that uses it."
            )
        try:
            self._room.get()
            self._raise_error()
            if self._closing:
                raise ClosedError(f"{self._name} is closed.")
            self._waiting.put((item,))
        except BaseException:
            # The next call must not wait for the room that this call took.
            self._room.put(None)
            raise

    def close(self) -> None:
        """Wait until every item is consumed and the thread has ended.

        May be called again, even after an interrupted call. If it is called on the
        thread itself (for example by a finalizer during garbage collection), it does
        the same as `leave`.

        Raises:
            BaseException: the exception that the function raised, unless `put` or an
                earlier `close` has already raised it.
        """
        self.leave()
        self._wait_for_end()
        if not self._error_was_raised:
            self._raise_error()

    def leave(self) -> None:
        """Close the queue. The thread consumes the waiting items and ends.

        Never blocks.
        """
        self._closing = True
        self._waiting.put(None)
        self._room.put(None)

    def abort(self) -> None:
        """Drop waiting items, wait for the current item, and end the thread.

        Idempotent; raises nothing. If the function may be blocked, unblock it first.
        If called on the thread itself, it does not wait.
        """
        self._aborted = True
        self.leave()
        self._wait_for_end()

    def _wait_for_end(self) -> None:
        # The thread cannot wait for itself, and a forked child does not have it.
        is_own = self._thread is threading.current_thread()
        if not is_own and os.getpid() == self._process_id:
            self._has_ended.wait()
            self._thread.join()

    def _raise_error(self) -> None:
        if self._error is not None:
            self._error_was_raised = True
            raise self._error

    def _work(self) -> None:
        try:
            while (item := self._waiting.get()) is not None:
                self._room.put(None)
                if not self._aborted:
                    self._consume(*item)
            if self._finish is not None and not self._aborted:
                self._finish()
        # All errors are kept for the caller, because on this thread they would be lost.
        except BaseException as error:
            self._error = error
            self._room.put(None)
        finally:
            self._has_ended.set()

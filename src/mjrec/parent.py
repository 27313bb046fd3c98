# SPDX-License-Identifier: Apache-2.0
"""The connection from a child process to its parent, which created a `Child`."""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import queue
import threading
from collections.abc import Callable
from typing import Any

from .messages import MOST_BYTES, PIPES_VARIABLE, STACKS_SIGNAL, packed, received


class Parent:
    """The connection to the process that started this one as a `Child`.

    Messages do not use standard input or output, because libraries and drivers print
    whenever they like. Standard input is empty, and standard output goes to standard
    error. Processes that this one starts or forks cannot use the connection.

    This process writes the stacks of its threads to standard error when `Child.stacks`
    requests them, and when a signal such as SIGSEGV kills it.
    """

    def __init__(self) -> None:
        faulthandler.enable()
        faulthandler.register(STACKS_SIGNAL)
        self._pipes = [int(number) for number in os.environ.pop(PIPES_VARIABLE).split()]
        for pipe in self._pipes:
            os.set_inheritable(pipe, False)
        self._orders, self._answers = self._pipes
        self._messages = received(self._orders, MOST_BYTES)
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._listens = False
        self._one_at_a_time = threading.Lock()
        os.register_at_fork(after_in_child=self._close)

    def receive(self, seconds: float | None = None) -> dict[str, Any]:
        """Wait for the parent's next message and return it.

        Args:
            seconds: maximum time to wait, if `listen` was called; None for no limit.

        Raises:
            queue.Empty: no message arrived within `seconds`.
            EOFError: the parent has ended, and `listen` was not called.
        """
        if self._listens:
            return self._said.get(timeout=seconds)
        for message in self._messages:
            assert isinstance(message, dict)
            return message
        raise EOFError

    @property
    def has_said_something(self) -> bool:
        """Whether a message is waiting. Only valid after `listen`."""
        return not self._said.empty()

    def listen(self, at_end: Callable[[], object] | None = None) -> None:
        """Receive on a thread from now on, to notice at once when the parent ends.

        Args:
            at_end: a function to call on that thread when the parent has ended. After
                that (or at once if None), this process exits, because nothing else
                needs its work.
        """
        self._listens = True
        threading.Thread(
            target=self._listen, args=[at_end], name="mjrec-parent", daemon=True
        ).start()

    def send(self, content: memoryview | None = None, **message: Any) -> None:
        """Send a message or the bytes of a frame. May be called from any thread."""
        parts = packed(message if content is None else content)
        # If the parent has ended, the thread of `listen` ends this process.
        with contextlib.suppress(OSError), self._one_at_a_time:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[os.write(self._answers, rest) :]

    def send_warnings(self) -> None:
        """From now on, send logged warnings and errors to the parent as `log`."""
        logging.getLogger().addHandler(_ToParent(self))

    def _listen(self, at_end: Callable[[], object] | None) -> None:
        # The connection is reset if the parent died before it had read everything.
        with contextlib.suppress(OSError):
            for message in self._messages:
                assert isinstance(message, dict)
                self._said.put(message)
        if at_end is not None:
            at_end()
        # `sys.exit` could wait for a driver.
        os._exit(0)

    def _close(self) -> None:
        while self._pipes:
            os.close(self._pipes.pop())


class _ToParent(logging.Handler):
    def __init__(self, parent: Parent) -> None:
        super().__init__(logging.WARNING)
        self._parent = parent

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._parent.send(log=[record.name, record.levelno, self.format(record)])
        except Exception:
            # No handler may let an error reach the code that logs.
            self.handleError(record)

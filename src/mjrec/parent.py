# SPDX-License-Identifier: Apache-2.0
"""The process that has started this one as its `Child`."""

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
    """The process that started this one, as its `Child`.

    Not through the standard input, which is empty, and the standard output, which is
    the standard error: libraries and drivers print whenever they like. What this
    process starts or forks cannot speak to it.

    Asked by `Child.stacks`, and when it dies of a signal such as SIGSEGV, this process
    writes what its threads are at to the standard error.
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
        """Return its next message, waiting for it.

        Args:
            seconds: to wait at most, where `listen` was called; None is for ever.

        Raises:
            queue.Empty: nothing has come in that time.
            EOFError: it has ended, and `listen` was not called.
        """
        if self._listens:
            return self._said.get(timeout=seconds)
        for message in self._messages:
            assert isinstance(message, dict)
            return message
        raise EOFError

    @property
    def has_said_something(self) -> bool:
        """Whether `receive` would not wait, where `listen` was called."""
        return not self._said.empty()

    def listen(self, at_end: Callable[[], object] | None = None) -> None:
        """Receive on a thread from now on, to notice its end whatever is done here.

        Args:
            at_end: called there when it has ended; ends this process. At once, if None:
                the work here has no other use.
        """
        self._listens = True
        threading.Thread(
            target=self._listen, args=[at_end], name="mjrec-parent", daemon=True
        ).start()

    def send(self, content: memoryview | None = None, **message: Any) -> None:
        """Send a message, or the bytes of a frame; from any thread."""
        parts = packed(message if content is None else content)
        # Where it has ended, `listen` sees to it.
        with contextlib.suppress(OSError), self._one_at_a_time:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[os.write(self._answers, rest) :]

    def send_warnings(self) -> None:
        """Send it what is logged here as a warning or worse, as `log`, from now on."""
        logging.getLogger().addHandler(_ToParent(self))

    def _listen(self, at_end: Callable[[], object] | None) -> None:
        # Reset, where it died before it had read everything.
        with contextlib.suppress(OSError):
            for message in self._messages:
                assert isinstance(message, dict)
                self._said.put(message)
        if at_end is not None:
            at_end()
        # Not `sys.exit`, which would wait for a driver.
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
            # As all handlers: who logs is not disturbed by it.
            self.handleError(record)

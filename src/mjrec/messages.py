# SPDX-License-Identifier: Apache-2.0
"""Messages between a process and its child, and the child's end of the connection.

A message is a JSON object or the bytes of a frame.

Errors are sent as JSON (`carried`, `unpacked`), because pickle would let a process that
writes into the pipe run code in this one.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import os
import queue
import signal
import struct
import threading
import traceback
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from .errors import KINDS, Error, rebuilt

logger = logging.getLogger(__name__)

Message: TypeAlias = "dict[str, Any] | bytearray"

# The variable that tells a child which descriptors to receive from and send to.
PIPES_VARIABLE = "MJREC_PARENT"
# The signal that makes a child write the stacks of its threads to standard error.
STACKS_SIGNAL = signal.SIGUSR1
# The maximum size of a message, larger than any frame. A larger one ends the stream.
MOST_BYTES = 1 << 32

# Each message starts with a flag (whether its content is a frame) and its length.
_HEADER = struct.Struct("=?Q")


def packed(
    message: Mapping[str, Any] | memoryview,
) -> tuple[bytes, bytes | memoryview]:
    """Return the parts of a message, to be written to a pipe one after another."""
    if isinstance(message, memoryview):
        return _HEADER.pack(True, message.nbytes), message.cast("B")
    content = json.dumps(message).encode()
    return _HEADER.pack(False, len(content)), content


def received(pipe: int, most_bytes: int) -> Generator[Message | None, None, None]:
    """Yield the messages from a pipe until it closes, and None while one is incomplete.

    Args:
        pipe: the descriptor to read from.
        most_bytes: maximum size of a message; a longer one ends the iterator.
    """
    with contextlib.suppress(EOFError):
        while True:
            is_frame, size = _HEADER.unpack((yield from _taken(pipe, _HEADER.size)))
            if size > most_bytes:
                logger.warning("An mjrec process sent invalid data.")
                return
            content = yield from _taken(pipe, size)
            if is_frame:
                yield content
                continue
            try:
                message = json.loads(content)
            except (ValueError, RecursionError):
                message = None
            if isinstance(message, dict):
                yield message
            else:
                logger.warning(
                    "An mjrec process sent an invalid message: %.200r", content
                )


def _taken(pipe: int, size: int) -> Generator[None, None, bytearray]:
    content = bytearray(size)
    missing = memoryview(content)
    while missing:
        try:
            count = os.readv(pipe, [missing])
        except BlockingIOError:
            yield None
            continue
        if not count:
            raise EOFError
        missing = missing[count:]
    return content


def log_message(message: Mapping[str, Any]) -> bool:
    """Log a child's message if it is a `log` message, and return whether it is."""
    if "log" in message:
        name, level, text = message["log"]
        logging.getLogger(name).log(level, "%s", text)
    return "log" in message


def carried(error: BaseException) -> dict[str, Any]:
    """Convert an error to plain JSON values, from which `unpacked` rebuilds it."""
    if not isinstance(error, Error):
        text = "".join(traceback.format_exception(error)).strip()
        return {
            "type": "Error",
            "message": f"A worker failed with an unexpected error.\n{text}",
        }
    # A module's private error class is sent as its nearest public base class.
    kinds = (kind.__name__ for kind in type(error).__mro__)
    return {
        "type": next(name for name in kinds if name in KINDS),
        "message": str(error),
        "facts": {k: _plain(v) for k, v in vars(error).items() if _is_plain(v)},
    }


def unpacked(plain: Mapping[str, Any]) -> Error:
    """Rebuild an error from the result of `carried`.

    The new error has the original class (or its nearest public base class), the same
    message, and the attributes that are numbers, strings, lists of these, paths or
    None.
    """
    facts = {
        key: Path(value["path"]) if isinstance(value, dict) else value
        for key, value in plain.get("facts", {}).items()
    }
    return rebuilt(KINDS.get(plain["type"], Error), plain["message"], facts)


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(isinstance(item, str | int | float) for item in value)
    return value is None or isinstance(value, str | int | float | Path)


def _plain(value: Any) -> Any:
    return {"path": str(value)} if isinstance(value, Path) else value


class Parent:
    """The connection to the process that started this one as a `Child`.

    Messages do not use standard input or output, because libraries and drivers may
    print at any time. Standard input is empty, and standard output goes to standard
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
        """From now on, receive on a thread that notices at once when the parent ends.

        Args:
            at_end: a function to call on that thread when the parent has ended. After
                that (or immediately, if None), this process exits, because nothing else
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
        # The connection is reset if the parent died before reading everything.
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
            # A handler must not raise errors in the code that logs.
            self.handleError(record)

# SPDX-License-Identifier: Apache-2.0
"""Messages between a process and its child: JSON objects and the bytes of frames.

Errors are sent as JSON (`carried`, `unpacked`), because pickle would let a process that
writes into the pipe run code in this one.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import struct
import traceback
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from .errors import KINDS, Error, rebuilt

logger = logging.getLogger(__name__)

Message: TypeAlias = "dict[str, Any] | bytearray"

# The variable that tells a child which descriptors to receive from and send to.
PIPES_VARIABLE = "MJREC_PARENT"
# The signal that makes a child write the stacks of its threads to standard error.
STACKS_SIGNAL = signal.SIGUSR1
# The maximum size of a message. No frame is as large; a longer message ends the stream.
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
        told = "".join(traceback.format_exception(error)).strip()
        return {
            "type": "Error",
            "message": f"A worker failed with an unexpected error.\n{told}",
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

# SPDX-License-Identifier: Apache-2.0
"""What a process and its child send to each other: JSON objects, and bytes of frames.

Errors come home as JSON (`carried`, `unpacked`): pickle would let a process that writes
into the pipe run code here.
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

# In the environment of a child: the descriptors that it receives from and sends to.
PIPES_VARIABLE = "MJREC_PARENT"
# What it is sent to write what its threads are at to its standard error.
STACKS_SIGNAL = signal.SIGUSR1
# Of a message; what is longer ends them. No frame is.
MOST_BYTES = 1 << 32

# Each message begins with whether it is the bytes of a frame, and its length.
_HEADER = struct.Struct("=?Q")


def packed(
    message: Mapping[str, Any] | memoryview,
) -> tuple[bytes, bytes | memoryview]:
    """Return a message as the parts that are to be written into a pipe."""
    if isinstance(message, memoryview):
        return _HEADER.pack(True, message.nbytes), message.cast("B")
    content = json.dumps(message).encode()
    return _HEADER.pack(False, len(content)), content


def received(pipe: int, most_bytes: int) -> Generator[Message | None, None, None]:
    """Yield what comes through a pipe until its end; None where it has to wait."""
    with contextlib.suppress(EOFError):
        while True:
            is_frame, size = _HEADER.unpack((yield from _taken(pipe, _HEADER.size)))
            if size > most_bytes:
                logger.warning("A process of mjrec's sends what is not understood.")
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
                    "A process of mjrec's said what is not understood: %.200r", content
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
    """Log here what a child has sent as `log`; return whether it is that."""
    if "log" in message:
        name, level, text = message["log"]
        logging.getLogger(name).log(level, "%s", text)
    return "log" in message


def carried(error: BaseException) -> dict[str, Any]:
    """Return what `unpacked` makes an error like `error` of, in plain JSON."""
    if not isinstance(error, Error):
        told = "".join(traceback.format_exception(error)).strip()
        return {
            "type": "Error",
            "message": f"A worker failed with an unexpected error.\n{told}",
        }
    # One that a module made of its own is known by the nearest that everybody knows.
    kinds = (kind.__name__ for kind in type(error).__mro__)
    return {
        "type": next(name for name in kinds if name in KINDS),
        "message": str(error),
        "facts": {k: _plain(v) for k, v in vars(error).items() if _is_plain(v)},
    }


def unpacked(plain: Mapping[str, Any]) -> Error:
    """Return the error that was carried.

    It has the class, the message and, of the attributes, numbers, texts, lists of them
    and paths.
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

# SPDX-License-Identifier: Apache-2.0
"""One drawing worker, seen from its pool."""

from __future__ import annotations

import collections
import contextlib
import fcntl
import json
import logging
import os
import struct
import sys
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..child_python import Child
from ..errors import Error
from ..frames import Frame
from ..patience import Patience

logger = logging.getLogger(__name__)

# What a worker sends begins with its kind and length.
HEADER = struct.Struct("=cQ")
FRAME, TEXT = b"F", b"T"

_MOST_BUFFERED = 2
# What users may have without privileges: one frame of 480x480, and more.
_PIPE_BYTES = 1 << 20


class PoolWorker:
    """A worker's process, which may be a second one, and its part of a job.

    Attributes:
        arrived: the frames that it has sent and that were not taken.
        owes: the positions of those that are to come.
        error: what there is instead of the next one.
    """

    def __init__(self) -> None:
        self.child: Child | None = None
        self.patience = Patience()
        self.shape = (0, 0, 3)
        self.arrived: collections.deque[Frame] = collections.deque()
        self.owes = range(0)
        self.error: Error | None = None
        self._lost_at: int | None = None
        self._drawing: Mapping[str, Any] = {}
        self._indices: Sequence[int] = ()

    @property
    def may_send(self) -> bool:
        """Whether there is something to come, and room for it."""
        is_full = len(self.arrived) >= _MOST_BUFFERED
        return bool(self.owes) and self.error is None and not is_full

    def start(self, environ: Mapping[str, str]) -> None:
        """Start the process, if there is none."""
        if self.child is not None:
            return
        try:
            # No directory of others is kept from being removed or unmounted.
            self.child = Child("mjrec.rendering.worker", environ=environ, cwd="/")
        except OSError as error:
            raise Error(
                f"No process that draws could be started: {sys.executable!r}: {error}."
            ) from error
        pipe = self.child.answers.fileno()
        os.set_blocking(pipe, False)
        # The system may grant no more than it has.
        with contextlib.suppress(OSError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._messages = _messages(pipe)

    def take(
        self, drawing: Mapping[str, Any], indices: Sequence[int], positions: range
    ) -> None:
        """Take over a part of a job."""
        self.leave()
        self._drawing, self._indices, self.owes = drawing, indices, positions
        if self.owes and self.child is not None:
            self.begin()

    def begin(self) -> None:
        """Tell the process what to draw."""
        assert self.child is not None
        runs = _runs(self._indices[position] for position in self.owes)
        order = json.dumps({"drawing": self._drawing, "runs": runs})
        self.patience.renew()
        # One that has died is noticed when it is listened to.
        with contextlib.suppress(OSError):
            self.child.orders.write(order.encode() + b"\n")

    def leave(self) -> None:
        """Forget the job; a process that has more to send of it is ended."""
        if self.owes and self.error is None:
            self.end()
        self.owes = range(0)
        self.error = self._lost_at = None
        self.arrived.clear()

    def next_message(self) -> tuple[bytes, bytearray] | None:
        """Return what it has sent; None if nothing more has come.

        Raises:
            EOFError: it has ended.
        """
        assert self.child is not None
        self.child.forget_words()
        return next(self._messages)

    def add(self, frame: bytearray) -> None:
        """Take in the next frame."""
        self.arrived.append(np.frombuffer(frame, np.uint8).reshape(self.shape))
        self.owes = self.owes[1:]

    def lose(self, what: str, how: str, *, kind: type[Error] = Error) -> None:
        """End the process; the second one that is lost at a frame is an error."""
        self.end()
        position = self.owes.start
        if self._lost_at == position:
            source = self._drawing.get("trajectory", "the given states")
            self.error = kind(
                f"A worker {what} while drawing frame {self._indices[position]} of "
                f"{source}, which was the second try: {how}"
            )
        else:
            logger.warning("A drawing worker %s and is replaced: %s", what, how)
        self._lost_at = position

    def end(self) -> None:
        """End the process, whatever it is at. Idempotent."""
        child, self.child = self.child, None
        if child is not None:
            child.end()


def _messages(pipe: int) -> Iterator[tuple[bytes, bytearray] | None]:
    """Yield kind and content of what comes through a pipe, None where it has to wait.

    Raises:
        EOFError: the pipe has ended.
    """
    while True:
        header = yield from _received(pipe, HEADER.size)
        kind, size = HEADER.unpack(header)
        content = yield from _received(pipe, size)
        yield kind, content


def _received(pipe: int, size: int) -> Generator[None, None, bytearray]:
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


def _runs(indices: Iterable[int]) -> list[tuple[int, int, int]]:
    """Return first, step and count of each even run in `indices`."""
    runs: list[tuple[int, int, int]] = []
    for index in map(int, indices):
        first, step, count = runs[-1] if runs else (0, 0, 0)
        if count == 1:
            runs[-1] = (first, index - first, 2)
        elif count > 1 and index == first + step * count:
            runs[-1] = (first, step, count + 1)
        else:
            runs.append((index, 0, 1))
    return runs

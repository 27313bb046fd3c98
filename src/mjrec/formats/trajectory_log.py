# SPDX-License-Identifier: Apache-2.0
"""The log of a recorded episode, which grows while the episode runs.

`openaigym.trajectory.<infix>.episode000027.log` is a line that says what it is and
then records, whole or not there: the header, a row for every step, a row for every
video frame, changes of the model, and facts that became known later. It is made for
the writing: a row costs the copying of its bytes, and blocks of rows go to the disk
in one call. `docs/format.md` describes every byte; `trajectory_log_reader` reads it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import threading
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import (
    ClosedError,
    DirectoryNotWritable,
    FileNotWritten,
    InvalidArgument,
)
from ..json_text import dumps
from .timely_flushing import flush_in_time
from .trajectory import (
    FORMAT_VERSION,
    Array,
    ModelChange,
    RowLayout,
    StateComponent,
    TrajectoryHeader,
)
from .trajectory_layout import (
    array_from_json,
    array_to_json,
    field_name,
    layout_to_json,
)

__all__ = [
    "CHANGE",
    "CHANGE_PREFIX",
    "FACTS",
    "FIRST_LINE",
    "FIRST_LINE_SIZE",
    "FRAME",
    "FRAME_PREFIX",
    "HEADER",
    "LONGEST_RECORD",
    "RECORD_PREFIX",
    "STEP",
    "STEP_PREFIX",
    "RowBlocks",
    "TrajectoryLogWriter",
    "checksum_seed",
    "facts_record",
    "padded",
    "write_all",
]

# The line is padded, so that every record begins at a multiple of 8 bytes.
FIRST_LINE_SIZE = 32
FIRST_LINE = b"mjrec trajectory log "

# Every record: kind, CRC-32 of kind, length and payload, length of the payload.
RECORD_PREFIX = struct.Struct("<4sIQ")
LONGEST_RECORD = 1 << 30

HEADER, STEP, FRAME, CHANGE, FACTS = b"head", b"step", b"fram", b"chng", b"fact"

# How the payloads of those that are not all JSON begin. Step: number, reward,
# terminated, truncated. Frame: number of the step. Change: number of the step, length
# of its table.
STEP_PREFIX = struct.Struct("<qd??6x")
FRAME_PREFIX = struct.Struct("<q")
CHANGE_PREFIX = struct.Struct("<qQ")

_CHECKSUM_OFFSET = 4

_Bytes = bytes | bytearray | memoryview

# Half as expensive as a file object, in an episode of twenty steps.
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC

# With the rounds of `timely_flushing` less than a second.
_FLUSH_SECONDS = 0.75
_BLOCK_BYTES = 1 << 18
_MOST_BLOCK_BYTES = 1 << 21
_MOST_ROWS = 512
# Model changes that wait; a texture is a megabyte.
_MOST_PENDING_BYTES = 1 << 20


def padded(length: int) -> int:
    """Return `length`, made a multiple of 8."""
    return -(-length // 8) * 8


def checksum_seed(kind: bytes, length: int) -> int:
    """Return the CRC-32 of a record's beginning, to go on from with its payload."""
    return zlib.crc32(kind + length.to_bytes(8, "little"))


class RowBlocks:
    """Memory for the rows that a log has not written yet.

    Making it costs more than a short episode's rows. One writer after the other can
    use the same: hand `writer.blocks` to the next one.

    Args:
        header: says what the rows look like; its facts do not matter.

    Raises:
        InvalidArgument: rows cannot look like that.
    """

    def __init__(self, header: TrajectoryHeader) -> None:
        try:
            layout = layout_to_json(header)
        except ValueError as error:
            raise InvalidArgument(f"A trajectory cannot be written: {error}.") from None
        self.layout_text = json.dumps(layout)
        self.free = True
        self._shape = _row_shape(header)
        arrays = [array for array in (header.action, header.observation) if array]
        filled = 8 * header.state_length + sum(array.size for array in arrays)
        self.steps = _Block(STEP, STEP_PREFIX.size, filled)
        self.frames = _Block(FRAME, FRAME_PREFIX.size, header.snapshot.size)

    def fit(self, header: TrajectoryHeader) -> bool:
        """Tell whether rows like `header` has them go in, and nobody uses these."""
        return self.free and self._shape == _row_shape(header)


class TrajectoryLogWriter:
    """Writes the log of one episode.

    The file appears with the first flush: when a block of rows is full, within a second
    of a row, at `flush`, or at `close`. A file of that name that is there already was
    left by a reset that another reset replaced, and is removed. What was flushed
    survives the death of the process.

    One thread uses it, and another flushes what that one leaves too long. A process
    forked from this one cannot: it can only `close`,
    which writes nothing there.

    Args:
        path: of the log; its directory exists.
        header: what is known of the episode, and what its rows look like.
        blocks: of a writer that is closed, to be used again; where they do not fit
            (another model, say) or are still in use, new ones are made.

    Attributes:
        path: of the log.
        is_there: the file was made.
        blocks: the memory in use.

    Raises:
        InvalidArgument: rows cannot look like that.
    """

    def __init__(
        self, path: Path, header: TrajectoryHeader, *, blocks: RowBlocks | None = None
    ) -> None:
        if blocks is None or not blocks.fit(header):
            blocks = RowBlocks(header)
        blocks.free = False
        self.path = path
        self.blocks = blocks
        self._steps = blocks.steps
        self._frames = blocks.frames
        self._process_id = os.getpid()
        self._lock = threading.RLock()
        self._descriptor: int | None = None
        self.is_there = False
        self._tail = _Tail(0, _beginning(header.facts, blocks.layout_text))
        flush_in_time(self)

    @property
    def closed(self) -> bool:
        """Whether it was closed or discarded."""
        return self._tail is _CLOSED

    def step_row(
        self, step: int, reward: float, terminated: bool, truncated: bool
    ) -> NDArray[np.uint8]:
        """Add the row of a step, and return the part of it that the caller fills.

        Args:
            step: 0 for the reset, which has no reward and no action, then 1, 2, 3 ...
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.

        Returns:
            State, action and observation, one behind the other, as bytes. All of it
            is to be filled before anything else is asked of this writer, and then
            `seal_row` called, or `withdraw_row`: what it holds now is some earlier
            row.

        Raises:
            FileNotWritten: the disk is full; nothing was added.
            ClosedError: after `close` or `discard`.
        """
        with self._lock:
            tail = self._tail
            index = tail.steps
            block = self._steps
            if index == block.capacity or monotonic() >= tail.due:
                self.flush()
                tail = self._tail
                index = 0
            row = block.rows[index] if index < len(block.rows) else block.next_row()
            STEP_PREFIX.pack_into(
                block.memory, block.starts[index], step, reward, terminated, truncated
            )
            tail.last = STEP
            tail.steps = index + 1
            return row

    def frame_row(self, step: int) -> NDArray[np.uint8]:
        """Add the row of a video frame, and return the part that the caller fills.

        Args:
            step: the step that the frame shows the end of, whose row is there.

        Returns:
            The snapshot, as bytes; as of `step_row`.

        Raises:
            FileNotWritten: the disk is full; nothing was added.
            ClosedError: after `close` or `discard`.
        """
        with self._lock:
            tail = self._tail
            index = tail.frames
            block = self._frames
            if index == block.capacity or tail is _CLOSED:
                self.flush()
                tail = self._tail
                index = 0
            row = block.rows[index] if index < len(block.rows) else block.next_row()
            FRAME_PREFIX.pack_into(block.memory, block.starts[index], step)
            tail.last = FRAME
            tail.frames = index + 1
            return row

    def add_moment(
        self,
        step: int,
        reward: float,
        terminated: bool,
        truncated: bool,
        row: bytes,
        snapshot: bytes,
    ) -> None:
        """Add the row of a step and that of its frame: both, or none of them.

        Args:
            step: as of `step_row`, as are the three after it.
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            row: what `step_row` would have the caller fill, of the same length.
            snapshot: likewise of `frame_row`.

        Raises:
            FileNotWritten: the disk is full; nothing was added.
            ClosedError: after `close` or `discard`.
        """
        with self._lock:
            tail = self._tail
            at, frame_at = tail.steps, tail.frames
            steps, frames = self._steps, self._frames
            if (
                at == steps.capacity
                or frame_at == frames.capacity
                or monotonic() >= tail.due
            ):
                self.flush()
                tail = self._tail
                at = frame_at = 0
            if at == len(steps.rows):
                steps.next_row()
            if frame_at == len(frames.rows):
                frames.next_row()
            start = steps.starts[at]
            STEP_PREFIX.pack_into(
                steps.memory, start, step, reward, terminated, truncated
            )
            start += STEP_PREFIX.size
            steps.memory[start : start + len(row)] = row
            start = frames.starts[frame_at]
            FRAME_PREFIX.pack_into(frames.memory, start, step)
            start += FRAME_PREFIX.size
            frames.memory[start : start + len(snapshot)] = snapshot
            tail.steps = at + 1
            tail.frames = frame_at + 1
            tail.last = b""

    def withdraw_row(self) -> None:
        """Take back the row that was given out last, because it could not be filled.

        Does nothing where that was done already, or the row was written.
        """
        with self._lock:
            tail = self._tail
            last, tail.last = tail.last, b""
            if last == STEP:
                tail.steps -= 1
            elif last == FRAME:
                tail.frames -= 1

    def seal_row(self) -> None:
        """Say that the row that was given out last is filled, and may be written."""
        self._tail.last = b""

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Add to the facts of the header; of a key that is there, the newest counts.

        Raises:
            ClosedError: after `close` or `discard`.
        """
        self._check_open()
        record = facts_record(facts)
        with self._lock:
            self._tail.facts += record

    def add_model_change(self, change: ModelChange) -> None:
        """Note what is other in the model from a step on.

        Raises:
            InvalidArgument: a field is no array of plain numbers, or has no name.
            FileNotWritten: the disk is full; the change was added and will be written
                by a later flush.
            ClosedError: after `close` or `discard`.
        """
        self._check_open()
        record = _record(CHANGE, *_change_parts(change))
        with self._lock:
            tail = self._tail
            tail.changes += record
            if len(tail.changes) > _MOST_PENDING_BYTES:
                self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            FileNotWritten: the disk is full, or the directory is gone. The log is as
                long as before, everything is kept, and another call tries again.
            ClosedError: after `close` or `discard`, or in a forked process.
        """
        with self._lock:
            self._check_open()
            self._check_process()
            tail = self._tail
            # In this order: a frame is never there without the model that it shows and
            # the step that it shows the end of, nor the end of the episode without all.
            parts: list[_Bytes] = [
                tail.beginning,
                tail.changes,
                self._steps.finished(tail.steps),
                self._frames.finished(tail.frames),
                tail.facts,
            ]
            size = self._write([part for part in parts if part], tail.offset)
            # One assignment: after Ctrl-C anywhere before it, the same bytes are
            # written to the same place again; after it, none of them.
            self._tail = _Tail(tail.offset + size)

    def flush_if_due(self) -> None:
        """Flush what has waited for long enough, on whichever thread.

        Not in the midst of a row. On a full disk it does nothing: whoever writes will
        find out.
        """
        if monotonic() < self._tail.due:
            return
        with self._lock:
            tail = self._tail
            if tail.last or tail is _CLOSED or monotonic() < tail.due:
                return
            with contextlib.suppress(FileNotWritten):
                self.flush()

    def renew_lock(self) -> None:
        """Make a new lock, in a forked child: another thread may have held the old."""
        self._lock = threading.RLock()

    def close(self) -> None:
        """Write everything and close the file. Idempotent.

        In a forked process, which is not the writing one, it only lets go.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        with self._lock:
            if self.closed:
                return
            if os.getpid() == self._process_id:
                self.flush()
            self._let_go()

    def abandon(self) -> None:
        """Close the file without writing what is not there yet. Idempotent.

        A file without anything in it is removed.
        """
        with self._lock:
            is_empty = not self.closed and self._tail.offset == 0
            self._let_go()
            if is_empty:
                self._remove()

    def discard(self) -> None:
        """Leave nothing, whether it was closed or not. Idempotent.

        Raises:
            DirectoryNotWritable: the file cannot be removed.
        """
        with self._lock:
            self._let_go()
            self._remove()

    def _remove(self) -> None:
        if self.is_there and os.getpid() == self._process_id:
            try:
                self.path.unlink(missing_ok=True)
            except OSError as error:
                raise DirectoryNotWritable(self.path.parent, error) from error
            self.is_there = False

    def __repr__(self) -> str:
        tail = self._tail
        state = "closed" if self.closed else f"{tail.offset} bytes written"
        return f"<{type(self).__name__} {str(self.path)!r} {state}>"

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedError(f"The trajectory {self.path} is closed.")

    def _check_process(self) -> None:
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The trajectory {self.path} belongs to process {self._process_id}, "
                "from which this one was forked: write it there."
            )

    def _write(self, parts: list[_Bytes], offset: int) -> int:
        """Write `parts` at `offset`, all of them or none, and return their size."""
        size = sum(len(part) for part in parts)
        try:
            descriptor = self._open() if self._descriptor is None else self._descriptor
            try:
                write_all(descriptor, parts, offset)
            except OSError:
                # A reader takes what is whole in any case, and the next try begins at
                # the same place.
                with contextlib.suppress(OSError):
                    os.ftruncate(descriptor, offset)
                raise
        except OSError as error:
            raise FileNotWritten(self.path, error.strerror or error) from error
        return size

    def _open(self) -> int:
        self.is_there = True
        try:
            self._descriptor = os.open(self.path, _NEW_FILE, 0o666)
        except FileExistsError:
            # Removed, not emptied: whoever reads the old one keeps it.
            self.path.unlink()
            self._descriptor = os.open(self.path, _NEW_FILE, 0o666)
        return self._descriptor

    def _let_go(self) -> None:
        if not self.closed:
            self._tail = _CLOSED
            self.blocks.free = True
            flush_in_time(self, is_open=False)
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)


class _Tail:
    """What of a log was not written yet, and where it goes.

    Attributes:
        offset: in the file.
        due: when to write it, by the monotonic clock.
        beginning: the first line and the header, where they were not written yet.
        steps: how many rows of its block are given out.
        frames: likewise.
        changes: whole records.
        facts: whole records.
        last: the kind of the row that was given out last.
    """

    __slots__ = (
        "beginning",
        "changes",
        "due",
        "facts",
        "frames",
        "last",
        "offset",
        "steps",
    )

    def __init__(self, offset: int, beginning: bytes = b"") -> None:
        self.offset = offset
        self.due = monotonic() + _FLUSH_SECONDS
        self.beginning = beginning
        self.steps = 0
        self.frames = 0
        self.changes = bytearray()
        self.facts = bytearray()
        self.last = b""


# Its time has always come, so that whoever adds a row asks no further.
_CLOSED = _Tail(0)
_CLOSED.due = float("-inf")


class _Block:
    """Memory for records of one kind and size, which are written together.

    Attributes:
        capacity: how many there is memory for.
        memory: of all of them.
        starts: where the payload of each begins in it.
        rows: of each that was used so far, the part behind `prefix_size`.
    """

    def __init__(self, kind: bytes, prefix_size: int, filled: int) -> None:
        self._kind = kind
        self._prefix_size = prefix_size
        self._length = prefix_size + filled
        self._stride = RECORD_PREFIX.size + padded(self._length)
        self._seed = checksum_seed(kind, self._length)
        self.capacity = _capacity(self._stride)
        # Zeros, because of the padding. The operating system gives the memory when it
        # is used.
        self._bytes = np.zeros(self.capacity * self._stride, np.uint8)
        self.memory = self._bytes.data
        first = RECORD_PREFIX.size
        self.starts = range(first, first + len(self._bytes), self._stride)
        self.rows: list[NDArray[np.uint8]] = []
        self._payloads: list[memoryview] = []
        self._checksums: NDArray[np.uint32] = np.ndarray(
            (self.capacity,),
            np.dtype("<u4"),
            buffer=self._bytes,
            offset=_CHECKSUM_OFFSET,
            strides=(self._stride,),
        )

    def next_row(self) -> NDArray[np.uint8]:
        """Return the first row that was not used so far."""
        start = self.starts[len(self.rows)]
        RECORD_PREFIX.pack_into(
            self.memory, start - RECORD_PREFIX.size, self._kind, 0, self._length
        )
        end = start + self._length
        row = self._bytes[start + self._prefix_size : end]
        self._payloads[len(self.rows) :] = [self.memory[start:end]]
        self.rows.append(row)
        return row

    def finished(self, count: int) -> memoryview:
        """Return the first `count` records, with their checksums."""
        crc32, seed = zlib.crc32, self._seed
        self._checksums[:count] = [
            crc32(payload, seed) for payload in self._payloads[:count]
        ]
        return self.memory[: count * self._stride]


_RowShape = tuple[tuple[StateComponent, ...], RowLayout, "Array | None", "Array | None"]


def _row_shape(header: TrajectoryHeader) -> _RowShape:
    return header.state, header.snapshot, header.action, header.observation


def _capacity(stride: int) -> int:
    """Return how many rows make a block."""
    at_least = min(8, _MOST_BLOCK_BYTES // stride)
    return max(1, at_least, min(_MOST_ROWS, _BLOCK_BYTES // stride))


def _beginning(facts: Mapping[str, Any], layout_text: str) -> bytes:
    line = FIRST_LINE + str(FORMAT_VERSION).encode()
    header = b'{"facts": %b, "rows": %b}' % (_json(facts), layout_text.encode())
    return line.ljust(FIRST_LINE_SIZE - 1) + b"\n" + _record(HEADER, header)


def facts_record(facts: Mapping[str, Any]) -> bytes:
    """Return the record by which a log learns facts."""
    return _record(FACTS, _json(facts))


def _record(kind: bytes, *parts: bytes) -> bytes:
    length = sum(len(part) for part in parts)
    if length > LONGEST_RECORD:
        raise InvalidArgument(
            f"A record of a trajectory may have {LONGEST_RECORD} bytes, not {length}."
        )
    checksum = checksum_seed(kind, length)
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    prefix = RECORD_PREFIX.pack(kind, checksum, length)
    return b"".join((prefix, *parts, bytes(padded(length) - length)))


def _change_parts(change: ModelChange) -> Iterable[bytes]:
    arrays = {
        name: np.asarray(values, order="C") for name, values in change.fields.items()
    }
    table = [
        {"name": name, **array_to_json(_kind_of(name, array))}
        for name, array in arrays.items()
    ]
    text = json.dumps(table).encode()
    yield CHANGE_PREFIX.pack(change.step, len(text))
    yield text
    for array in arrays.values():
        yield array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def _kind_of(name: str, array: NDArray[Any]) -> Array:
    kind = Array(array.dtype.newbyteorder("<").str, array.shape)
    try:
        field_name(name)
        return array_from_json(array_to_json(kind))
    except ValueError as error:
        raise InvalidArgument(
            f"The model field {name!r} cannot be recorded: {error}."
        ) from None


_PLAIN_JSON = json.JSONEncoder(allow_nan=False)


def _json(values: Mapping[str, Any]) -> bytes:
    # The plain encoder takes a tenth of the time where there is nothing but JSON's own
    # types, as usual.
    try:
        return _PLAIN_JSON.encode(values).encode()
    except (TypeError, ValueError, RecursionError):
        return dumps(dict(values)).encode()


def write_all(
    descriptor: int, parts: Sequence[bytes | bytearray | memoryview], offset: int
) -> None:
    """Write all parts, one behind the other, from `offset` on.

    Raises:
        OSError: the disk is full; the system may have written some of it.
    """
    left = sum(len(part) for part in parts)
    written = os.pwritev(descriptor, parts, offset) if parts else 0
    if written == left:
        return
    rest = memoryview(b"".join(parts))
    while written < left:
        count = os.pwrite(descriptor, rest[written:], offset + written)
        if count == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written += count

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any
from zlib import crc32

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

_Bytes = bytes | bytearray | memoryview

# Half as expensive as a file object, in an episode of twenty steps.
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC

# With the rounds of `timely_flushing` less than a second.
_FLUSH_SECONDS = 0.75
# When so much waits, nothing more is taken before it is written. Not on the thread that
# flushes: it would have to share the interpreter's lock with the simulation, which
# costs more than writing does.
_FLUSH_BYTES = 1 << 18
# Model changes that wait; a texture is a megabyte.
_MOST_CHANGED_BYTES = 1 << 20


def padded(length: int) -> int:
    """Return `length`, made a multiple of 8."""
    return -(-length // 8) * 8


def checksum_seed(kind: bytes, length: int) -> int:
    """Return the CRC-32 of a record's beginning, to go on from with its payload."""
    return crc32(kind + length.to_bytes(8, "little"))


class RowFormat:
    """What the rows of a log are like, ready to be written.

    Finding it out costs more than a short episode's rows: hand `writer.rows` to the
    writer of the next log.

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
        self._described = _described(header)
        arrays = [array for array in (header.action, header.observation) if array]
        filled = 8 * header.state_length + sum(array.size for array in arrays)
        self.step = _RowRecord(STEP, STEP_PREFIX.size, filled)
        self.frame = _RowRecord(FRAME, FRAME_PREFIX.size, header.snapshot.size)

    def fits(self, header: TrajectoryHeader) -> bool:
        """Tell whether the rows of `header` are like these."""
        return self._described == _described(header)


class TrajectoryLogWriter:
    """Writes the log of one episode.

    The file appears with the first flush: when enough rows wait, within a second
    of a row, at `flush`, or at `close`. A file of that name that is there already was
    left by a reset that another reset replaced, and is removed. What was flushed
    survives the death of the process.

    One thread uses it, and another flushes what that one leaves too long. A process
    forked from this one cannot use it: it can only `close`, which writes nothing there.

    Args:
        path: of the log; its directory exists.
        header: what is known of the episode, and what its rows look like.
        rows: of another writer; where they do not fit (another model, say), they are
            found out anew.

    Attributes:
        path: of the log.
        is_there: the file was made.
        rows: what they are like.
        steps: the number of the last step; 0 before.
        frame_count: how many frames there are.
        last_frame: the step of the last one; -1 before.

    Raises:
        InvalidArgument: rows cannot look like that.
    """

    def __init__(
        self, path: Path, header: TrajectoryHeader, *, rows: RowFormat | None = None
    ) -> None:
        if rows is None or not rows.fits(header):
            rows = RowFormat(header)
        self.path = path
        self.rows = rows
        self._step, self._frame = rows.step, rows.frame
        self._step_size, self._frame_size = rows.step.size, rows.frame.size
        self._process_id = os.getpid()
        self.renew_locks()
        self._descriptor: int | None = None
        self.is_there = False
        self.steps = 0
        self.frame_count = 0
        self.last_frame = -1
        self._tail = _Tail(0)
        self._tail.records = [_beginning(header.facts, rows.layout_text)]
        flush_in_time(self)

    @property
    def closed(self) -> bool:
        """Whether it was closed or discarded."""
        return self._tail is _CLOSED

    def add_step(
        self,
        step: int,
        reward: float,
        terminated: bool,
        truncated: bool,
        row: Iterable[_Bytes],
    ) -> None:
        """Add the row of a step.

        Args:
            step: 0 for the reset, which has no reward and no action, then 1, 2, 3 ...
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            row: state, action and observation, in pieces as they come.

        Raises:
            FileNotWritten: the disk is full; nothing was added.
            InvalidArgument: the row has another size than the header says.
            ClosedError: after `close` or `discard`.
        """
        prefix = STEP_PREFIX.pack(step, reward, terminated, truncated)
        records = self._step.record(prefix, row)
        self._make_room()
        with self._adding:
            # No call in here: a signal's handler that raises does so after one, and
            # what is counted has to be what is there.
            tail = self._tail
            tail.records += records
            tail.size += self._step_size
            self.steps = step

    def add_frame(self, step: int, snapshot: Iterable[_Bytes]) -> None:
        """Add the row of a video frame.

        Args:
            step: the step that the frame shows the end of, whose row is there.
            snapshot: in pieces as they come.

        Raises:
            FileNotWritten: the disk is full; nothing was added.
            InvalidArgument: the snapshot has another size than the header says.
            ClosedError: after `close` or `discard`.
        """
        prefix = FRAME_PREFIX.pack(step)
        records = self._frame.record(prefix, snapshot)
        self._make_room()
        with self._adding:
            # No call, as in `add_step`.
            tail = self._tail
            tail.records += records
            tail.size += self._frame_size
            self.last_frame = step
            self.frame_count += 1

    def steps_of(self, row: Sequence[memoryview]) -> Callable[[int, float], None]:
        """Return what adds a step from the same memory, as `moments_of` does.

        Raises:
            InvalidArgument: the row has another size than the header says.
        """
        self._step.check(sum(piece.nbytes for piece in row))

        def add_step(step: int, reward: float) -> None:
            self.add_step(step, reward, False, False, row)

        return add_step

    def moments_of(
        self, row: Sequence[memoryview], snapshot: Sequence[memoryview]
    ) -> Callable[[int, float], None]:
        """Return what adds a step and its frame, both or none, from the same memory.

        Every usual step of every recorded episode goes this way, in half the time of
        `add_step` and `add_frame`.

        Args:
            row: state, action and observation, in the pieces in which they are kept.
            snapshot: likewise.

        Returns:
            A function of the step's number and its reward, for steps that end no
            episode. It raises FileNotWritten, with nothing added, where the disk is
            full, and ClosedError after `close` or `discard`.

        Raises:
            InvalidArgument: one of them has another size than the header says.
        """
        self._step.check(sum(piece.nbytes for piece in row))
        self._frame.check(sum(piece.nbytes for piece in snapshot))
        # All at hand: nothing is looked up that can be known.
        step_length, step_seed, step_padding = self._step.constants
        frame_length, frame_seed, frame_padding = self._frame.constants
        size = self._step.size + self._frame.size
        pack_step, pack_frame = STEP_PREFIX.pack, FRAME_PREFIX.pack
        pack, join = RECORD_PREFIX.pack, b"".join

        def add_moment(step: int, reward: float) -> None:
            of_step = join((pack_step(step, reward, False, False), *row))
            of_frame = join((pack_frame(step), *snapshot))
            records = (
                pack(STEP, crc32(of_step, step_seed), step_length),
                of_step,
                step_padding,
                pack(FRAME, crc32(of_frame, frame_seed), frame_length),
                of_frame,
                frame_padding,
            )
            if self._tail.size >= _FLUSH_BYTES:
                self.flush()
            with self._adding:
                # No call, as in `add_step`.
                tail = self._tail
                tail.records += records
                tail.size += size
                self.steps = self.last_frame = step
                self.frame_count += 1

        return add_moment

    def _make_room(self) -> None:
        # Beside `_adding`, never inside it: who flushes may have to wait for the other
        # thread, which asks for it while it writes.
        if self._tail.size >= _FLUSH_BYTES:
            self.flush()

    def add_facts(self, facts: Mapping[str, Any]) -> None:
        """Add to the facts of the header; of a key that is there, the newest counts.

        Raises:
            ClosedError: after `close` or `discard`.
        """
        self._check_open()
        record = facts_record(facts)
        with self._adding:
            self._tail.records.append(record)

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
        with self._adding:
            tail = self._tail
            tail.records.append(record)
            tail.changed += len(record)
        if tail.changed > _MOST_CHANGED_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            FileNotWritten: the disk is full, or the directory is gone. The log is as
                long as before, everything is kept, and another call tries again.
            ClosedError: after `close` or `discard`, or in a forked process.
        """
        with self._writing:
            self._check_open()
            self._check_process()
            tail = self._tail
            size = self._write(tail.records, tail.offset)
            # One assignment: after Ctrl-C anywhere before it, the same bytes are
            # written to the same place again; after it, none of them.
            self._tail = _Tail(tail.offset + size)

    @property
    def is_due(self) -> bool:
        """Whether something has waited for long enough. For any thread."""
        return monotonic() >= self._tail.due

    def flush_beside(self) -> None:
        """Flush while rows may be added, on another thread than the one that adds them.

        On a full disk it does nothing: whoever writes will find out.
        """
        with self._writing:
            with self._adding:
                tail = self._tail
                if tail is _CLOSED or not tail.records:
                    return
                size = sum(map(len, tail.records))
                self._tail = _Tail(tail.offset + size)
            try:
                self._write(tail.records, tail.offset)
            except BaseException as error:
                with self._adding:
                    tail.take_back(self._tail)
                    self._tail = tail
                if not isinstance(error, FileNotWritten):
                    raise

    def renew_locks(self) -> None:
        """Make new locks, in a forked child: another thread may have held the old."""
        # Whoever has `_writing` changes the file, and has `_adding` at most inside it.
        self._writing = threading.RLock()
        self._adding = threading.RLock()

    def close(self) -> None:
        """Write everything and close the file. Idempotent.

        In a forked process, which is not the writing one, it only lets go.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        with self._writing:
            if self.closed:
                return
            if os.getpid() == self._process_id:
                self.flush()
            self._let_go()

    def abandon(self) -> None:
        """Close the file without writing what is not there yet. Idempotent.

        A file without anything in it is removed.
        """
        with self._writing:
            is_empty = not self.closed and self._tail.offset == 0
            self._let_go()
            if is_empty:
                self._remove()

    def discard(self) -> None:
        """Leave nothing, whether it was closed or not. Idempotent.

        Raises:
            DirectoryNotWritable: the file cannot be removed.
        """
        with self._writing:
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

    def _write(self, records: list[bytes], offset: int) -> int:
        """Write `records` at `offset`, all of them or none, and return their size."""
        whole = b"".join(records)
        try:
            descriptor = self._open() if self._descriptor is None else self._descriptor
            try:
                write_all(descriptor, whole, offset)
            except OSError:
                # A reader takes what is whole in any case, and the next try begins at
                # the same place.
                with contextlib.suppress(OSError):
                    os.ftruncate(descriptor, offset)
                raise
        except OSError as error:
            raise FileNotWritten(self.path, error.strerror or error) from error
        return len(whole)

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
            flush_in_time(self, is_open=False)
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)


class _Tail:
    """What of a log was not written yet, and where it goes.

    Attributes:
        offset: in the file.
        due: when to write it, by the monotonic clock.
        records: in their order, in pieces.
        size: the bytes of those that are rows.
        changed: the bytes of those that are model changes.
    """

    __slots__ = ("changed", "due", "offset", "records", "size")

    def __init__(self, offset: int) -> None:
        self.offset = offset
        self.due = monotonic() + _FLUSH_SECONDS
        self.records: list[bytes] = []
        self.size: float = 0
        self.changed = 0

    def take_back(self, later: _Tail) -> None:
        """Add what has come after it."""
        self.records += later.records
        self.size += later.size
        self.changed += later.changed


# It is always full, so that whoever adds a row asks no further.
_CLOSED = _Tail(0)
_CLOSED.due = float("-inf")
_CLOSED.size = float("inf")


class _RowRecord:
    """Makes records of one kind and size.

    Args:
        kind: of the records.
        prefix_size: how many bytes the payload has before the row.
        filled: how many the row has.
    """

    def __init__(self, kind: bytes, prefix_size: int, filled: int) -> None:
        self.kind = kind
        self.prefix_size = prefix_size
        self.length = prefix_size + filled
        self.seed = checksum_seed(kind, self.length)
        self.padding = bytes(padded(self.length) - self.length)

    @property
    def constants(self) -> tuple[int, int, bytes]:
        """What all have: length and seed for the prefix, and the padding."""
        return self.length, self.seed, self.padding

    @property
    def size(self) -> int:
        """The bytes of one, with all that is around its payload."""
        return RECORD_PREFIX.size + padded(self.length)

    def check(self, filled: int) -> None:
        """Check that a row has the size of all of them.

        Raises:
            InvalidArgument: it has another.
        """
        if self.prefix_size + filled != self.length:
            raise InvalidArgument(
                f"A {self.kind.decode()!r} row of this log has "
                f"{self.length - self.prefix_size} bytes, not {filled}."
            )

    def record(self, prefix: bytes, row: Iterable[_Bytes]) -> tuple[bytes, ...]:
        """Return the record of a row, in pieces.

        Raises:
            InvalidArgument: it has another size.
        """
        payload = b"".join((prefix, *row))
        self.check(len(payload) - self.prefix_size)
        checksum = crc32(payload, self.seed)
        return (
            RECORD_PREFIX.pack(self.kind, checksum, self.length),
            payload,
            self.padding,
        )


_Described = tuple[
    tuple[StateComponent, ...], RowLayout, "Array | None", "Array | None"
]


def _described(header: TrajectoryHeader) -> _Described:
    return header.state, header.snapshot, header.action, header.observation


def _beginning(facts: Mapping[str, Any], layout_text: str) -> bytes:
    line = FIRST_LINE + str(FORMAT_VERSION).encode()
    header = b'{"facts": %b, "rows": %b}' % (
        dumps(dict(facts)).encode(),
        layout_text.encode(),
    )
    return line.ljust(FIRST_LINE_SIZE - 1) + b"\n" + _record(HEADER, header)


def facts_record(facts: Mapping[str, Any]) -> bytes:
    """Return the record by which a log learns facts."""
    return _record(FACTS, dumps(dict(facts)).encode())


def _record(kind: bytes, *parts: bytes) -> bytes:
    length = sum(len(part) for part in parts)
    if length > LONGEST_RECORD:
        raise InvalidArgument(
            f"A record of a trajectory may have {LONGEST_RECORD} bytes, not {length}."
        )
    checksum = checksum_seed(kind, length)
    for part in parts:
        checksum = crc32(part, checksum)
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


def write_all(descriptor: int, data: _Bytes, offset: int) -> None:
    """Write all of `data`, from `offset` on.

    Raises:
        OSError: the disk is full; the system may have written some of it.
    """
    left = memoryview(data)
    while left:
        count = os.pwrite(descriptor, left, offset)
        if count == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left = left[count:]
        offset += count

# SPDX-License-Identifier: Apache-2.0
"""Reading the log of a recorded episode: of a living process, a dead one, an ended one.

What is whole up to the first record that is torn or damaged is read; the rest is
counted. A frame beyond the last step is left out too: the step that it shows the end
of is not known.
"""

from __future__ import annotations

import array
import bisect
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ClosedError
from ..json_text import loads
from .json_fields import field, json_object, list_of, mapping, unreadable
from .regular_files import open_regular
from .trajectory import Array, ModelChange
from .trajectory_layout import (
    array_from_json,
    check_version,
    field_name,
    header_from_json,
)
from .trajectory_log import (
    CHANGE,
    CHANGE_PREFIX,
    FACTS,
    FIRST_LINE,
    FIRST_LINE_SIZE,
    FRAME,
    FRAME_PREFIX,
    HEADER,
    LONGEST_RECORD,
    RECORD_PREFIX,
    STEP,
    STEP_PREFIX,
    checksum_seed,
    padded,
)
from .trajectory_reader import TrajectoryReader

_KINDS = frozenset((HEADER, STEP, FRAME, CHANGE, FACTS))

# What is read at once while looking through a log.
_WINDOW = 1 << 20
# Of all facts together: they are kept in memory.
_LONGEST_JSON = 1 << 26


class TrajectoryLogReader(TrajectoryReader):
    """Reads what the log holds at the moment of opening.

    Raises:
        UnreadableFile: it is no log, or of a newer version, or its header is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped = 0
        with unreadable(path):
            self._file = open_regular(path)
            try:
                self._look_through()
            except BaseException:
                self._file.close()
                raise

    def close(self) -> None:
        """Close the file; idempotent. What is in memory stays."""
        self._file.close()

    def _look_through(self) -> None:
        window = _Window(self._file.fileno())
        _check_first_line(bytes(window.read(0, FIRST_LINE_SIZE)))
        records = _records(window)
        first = next(records, None)
        self._facts, rows = _header(window, first)
        self._json_length = 0 if first is None else first.length
        self.header = header_from_json(self._facts, rows)
        self._prepare()
        for record in records:
            if not (self._is_sound(window, record) and self._take(window, record)):
                self.dropped = 1 + sum(1 for _ in records)
                break
        self._finish()

    def _prepare(self) -> None:
        header = self.header
        arrays = [kind for kind in (header.action, header.observation) if kind]
        self._state_size = 8 * header.state_length
        filled = self._state_size + sum(kind.size for kind in arrays)
        self._steps = _Rows(STEP, STEP_PREFIX.size + filled)
        self._frames = _Rows(FRAME, FRAME_PREFIX.size + header.snapshot.size)
        # Not lists of numbers, each of which would be an object.
        self._rewards = array.array("d")
        self._flags = {name: bytearray() for name in ("terminated", "truncated")}
        self._frame_steps = array.array("q")
        self._changes: list[_Record] = []

    def _finish(self) -> None:
        self.row_count = self._steps.count
        # The row of the reset has none.
        self.rewards = np.array(self._rewards[1:], np.float64)
        self.terminated = np.array(self._flags["terminated"][1:], np.bool_)
        self.truncated = np.array(self._flags["truncated"][1:], np.bool_)
        known = bisect.bisect_left(self._frame_steps, self.row_count)
        self.dropped += len(self._frame_steps) - known
        self.frame_steps = np.array(self._frame_steps[:known], np.int64)
        self.change_count = len(self._changes)

    def _is_sound(self, window: _Window, record: _Record) -> bool:
        return record.whole and _checksum(window, record) == record.checksum

    def _take(self, window: _Window, record: _Record) -> bool:
        """Take in a record that is as it was written; False where it cannot follow."""
        if record.kind == STEP:
            return self._take_step(window, record)
        if record.kind == FRAME:
            return self._take_frame(window, record)
        if record.kind == CHANGE:
            self._changes.append(record)
        elif record.kind == FACTS:
            self._json_length += record.length
            if self._json_length > _LONGEST_JSON:
                raise ValueError("its facts are too long")
            self._facts.update(_object(window, record))
        return record.kind != HEADER

    def _take_step(self, window: _Window, record: _Record) -> bool:
        if record.length != self._steps.length:
            return False
        prefix = window.read(record.offset, STEP_PREFIX.size)
        step, reward, terminated, truncated = STEP_PREFIX.unpack(prefix)
        if step != self._steps.count:
            return False
        self._steps.add(record.offset)
        self._rewards.append(reward)
        self._flags["terminated"].append(terminated)
        self._flags["truncated"].append(truncated)
        return True

    def _take_frame(self, window: _Window, record: _Record) -> bool:
        if record.length != self._frames.length:
            return False
        prefix = window.read(record.offset, FRAME_PREFIX.size)
        (step,) = FRAME_PREFIX.unpack(prefix)
        if step < (self._frame_steps[-1] if self._frame_steps else 0):
            return False
        self._frames.add(record.offset)
        self._frame_steps.append(step)
        return True

    def _states(self, start: int, stop: int) -> NDArray[np.float64]:
        kind = Array("<f8", (self.header.state_length,))
        return self._cut(self._steps, start, stop, STEP_PREFIX.size, kind)

    def _actions(self, start: int, stop: int) -> NDArray[Any]:
        assert self.header.action is not None
        offset = STEP_PREFIX.size + self._state_size
        # The row of step k has the action that led there; that of the reset has none.
        return self._cut(self._steps, start + 1, stop + 1, offset, self.header.action)

    def _observations(self, start: int, stop: int) -> NDArray[Any]:
        assert self.header.observation is not None
        offset = self._steps.length - self.header.observation.size
        return self._cut(self._steps, start, stop, offset, self.header.observation)

    def _snapshots(self, start: int, stop: int) -> NDArray[np.uint8]:
        kind = Array("|u1", (self.header.snapshot.size,))
        return self._cut(self._frames, start, stop, FRAME_PREFIX.size, kind)

    def _cut(
        self, rows: _Rows, start: int, stop: int, offset: int, kind: Array
    ) -> NDArray[Any]:
        """Return one of the arrays that the payloads of some rows hold at `offset`."""
        self._check_open()
        payloads = np.empty((stop - start, rows.stride), np.uint8)
        with unreadable(self.path):
            rows.read(self._file.fileno(), start, payloads)
        first = RECORD_PREFIX.size + offset
        part = np.ascontiguousarray(payloads[:, first : first + kind.size])
        return part.view(kind.dtype).reshape(stop - start, *kind.shape)

    def _model_change(self, index: int) -> ModelChange:
        self._check_open()
        record = self._changes[index]
        with unreadable(self.path):
            payload = os.pread(self._file.fileno(), record.length, record.offset)
            return _parse_change(payload)

    def _check_open(self) -> None:
        if self._file.closed:
            raise ClosedError(f"The trajectory {self.path} is closed.")


def end_of_records(descriptor: int) -> int:
    """Return where the next record of an open log belongs: behind the last whole one.

    Whether what the records hold is as it was written is not looked at.

    Raises:
        ValueError: it is no log, or something else than a part of a record stands
            behind the last whole one.
    """
    window = _Window(descriptor)
    _check_first_line(bytes(window.read(0, FIRST_LINE_SIZE)))
    end = FIRST_LINE_SIZE
    for record in _records(window):
        if record.whole:
            end = record.offset + padded(record.length)
        elif record.kind not in (*_KINDS, b"") or record.length > LONGEST_RECORD:
            raise ValueError("it is damaged")
    return end


def _check_first_line(line: bytes) -> None:
    """Raise `ValueError` unless a file that begins so is a log that can be read."""
    if not line.startswith(FIRST_LINE):
        raise ValueError("it is no trajectory")
    number = line[len(FIRST_LINE) :].strip()
    if len(line) < FIRST_LINE_SIZE or not line.endswith(b"\n"):
        raise ValueError("it was cut off in its first line")
    if not number.isdigit():
        raise ValueError("its first line names no format version")
    check_version(int(number))


class _Record(NamedTuple):
    """Where a record is; `offset` and `length` are those of its payload."""

    kind: bytes
    checksum: int
    offset: int
    length: int
    whole: bool


class _Window:
    """A part of a file in memory, so that many small reads are few.

    The size of the file is that at the beginning: a living log grows.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.size = os.fstat(descriptor).st_size
        self._start = 0
        self._bytes = memoryview(b"")

    def read(self, offset: int, length: int) -> memoryview:
        """Return up to `length` bytes, of at most `_WINDOW`; fewer at the end."""
        start = offset - self._start
        if start < 0 or start + length > len(self._bytes):
            self._bytes = memoryview(os.pread(self._descriptor, _WINDOW, offset))
            self._start, start = offset, 0
        return self._bytes[start : start + length]


class _Rows:
    """Where the rows of one kind are: in runs, one row behind the other.

    Attributes:
        count: how many there are.
        length: of a payload.
        stride: from one record of a run to the next.
    """

    def __init__(self, kind: bytes, length: int) -> None:
        self.count = 0
        self.length = length
        self.stride = RECORD_PREFIX.size + padded(length)
        self._kind = kind
        self._first_rows: list[int] = []
        self._offsets: list[int] = []
        self._end = -1

    def add(self, payload_offset: int) -> None:
        """Add the row whose payload is at `payload_offset`."""
        offset = payload_offset - RECORD_PREFIX.size
        if offset != self._end:
            self._first_rows.append(self.count)
            self._offsets.append(offset)
        self._end = offset + self.stride
        self.count += 1

    def read(self, descriptor: int, start: int, out: NDArray[np.uint8]) -> None:
        """Fill `out`, `(n, stride)`, with the records from row `start` on."""
        done = 0
        while done < len(out):
            run = bisect.bisect_right(self._first_rows, start + done) - 1
            skipped = start + done - self._first_rows[run]
            is_last = run + 1 == len(self._first_rows)
            end = self.count if is_last else self._first_rows[run + 1]
            part = out[done : done + end - start - done]
            _fill(descriptor, self._offsets[run] + skipped * self.stride, part)
            done += len(part)
        # A log that somebody writes to on a full disk may lose its end once more.
        if not (out[:, :4] == np.frombuffer(self._kind, np.uint8)).all():
            raise ValueError("it changed while it was read")


def _fill(descriptor: int, offset: int, out: NDArray[np.uint8]) -> None:
    left = out.data.cast("B")
    while left:
        count = os.preadv(descriptor, [left], offset)
        if count == 0:
            raise ValueError("it became shorter while it was read")
        left = left[count:]
        offset += count


def _records(window: _Window) -> Iterator[_Record]:
    """Yield what is there, up to the first place where no record can begin."""
    position = FIRST_LINE_SIZE
    while position < window.size:
        beginning = window.read(position, RECORD_PREFIX.size)
        offset = position + RECORD_PREFIX.size
        if len(beginning) < RECORD_PREFIX.size:
            yield _Record(b"", 0, offset, 0, whole=False)
            return
        kind, checksum, length = RECORD_PREFIX.unpack(beginning)
        position = offset + padded(length)
        whole = kind in _KINDS and length <= LONGEST_RECORD and position <= window.size
        yield _Record(kind, checksum, offset, length, whole)
        if not whole:
            return


def _checksum(window: _Window, record: _Record) -> int:
    checksum = checksum_seed(record.kind, record.length)
    offset, left = record.offset, record.length
    while left and (piece := window.read(offset, min(left, _WINDOW))):
        checksum = zlib.crc32(piece, checksum)
        offset += len(piece)
        left -= len(piece)
    return checksum if not left else -1


def _header(
    window: _Window, record: _Record | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    if record is None or not record.whole:
        raise ValueError("it was cut off before the end of its header")
    if record.kind != HEADER or _checksum(window, record) != record.checksum:
        raise ValueError("its header is damaged")
    values = _object(window, record)
    facts, rows = field(values, "facts", mapping), field(values, "rows", mapping)
    return dict(facts), dict(rows)


def _object(window: _Window, record: _Record) -> dict[str, Any]:
    if record.length > _LONGEST_JSON:
        raise ValueError("its facts are too long")
    pieces: list[bytes] = []
    offset, left = record.offset, record.length
    while left and (piece := window.read(offset, min(left, _WINDOW))):
        pieces.append(bytes(piece))
        offset += len(piece)
        left -= len(piece)
    return dict(json_object(b"".join(pieces)))


def _parse_change(payload: bytes) -> ModelChange:
    if len(payload) < CHANGE_PREFIX.size:
        raise ValueError("a change of the model is damaged")
    step, table_size = CHANGE_PREFIX.unpack_from(payload)
    if step < 0:
        raise ValueError("a change of the model is of no step")
    offset = CHANGE_PREFIX.size + table_size
    if offset > len(payload):
        raise ValueError("a change of the model is damaged")
    table = list_of(_named_array)(_parse_table(payload[CHANGE_PREFIX.size : offset]))
    if offset + sum(kind.size for _, kind in table) != len(payload):
        raise ValueError("a change of the model has another size than its fields")
    if len({name for name, _ in table}) != len(table):
        raise ValueError("a change of the model has two fields of the same name")
    fields: dict[str, NDArray[Any]] = {}
    for name, kind in table:
        count = math.prod(kind.shape)
        values = np.frombuffer(payload, kind.dtype, count, offset)
        # A copy can be written to, and does not keep the rest.
        fields[name] = values.reshape(kind.shape).copy()
        offset += kind.size
    return ModelChange(step=step, fields=fields)


def _parse_table(text: bytes) -> Any:
    try:
        return loads(text)
    except (RecursionError, ValueError) as error:
        raise ValueError("the table of a change of the model is damaged") from error


def _named_array(value: Any) -> tuple[str, Array]:
    values = mapping(value)
    return field(values, "name", field_name), array_from_json(values)

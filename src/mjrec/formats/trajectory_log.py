# SPDX-License-Identifier: Apache-2.0
"""A reader for recordings in flight, which works even if their process has died.

A row is valid only if it contains its own number, because after a machine crash, pages
of a log may lack the data that was written to them.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, UnreadableFile
from .json_fields import unreadable
from .regular_files import open_regular
from .row_log import RowLogReader
from .spans import LOOKS, Recording, find_recording
from .trajectory import (
    FRAME,
    STEP,
    TERMINATED,
    TRUNCATED,
    ModelChange,
    TrajectoryReader,
    check_dtype,
)

# Every row has a step, a frame, or both.
_KINDS = STEP | FRAME

# Number of bytes read at a time when scanning the rows.
_CHUNK_BYTES = 1 << 22

# The header of a change to the model: the first row to which it applies, its step, and
# the length of the record after the header.
_CHANGE = struct.Struct("<QqQ")
_LONGEST_HEADER = 1 << 16
_LARGEST_CHANGE = 1 << 30


def open_recording(path: Path) -> TrajectoryReader:
    """Open a recording with the rows that its log contains at this moment.

    Args:
        path: the file that the recording will become.

    Raises:
        UnreadableFile: the recording does not exist, or its log is damaged or has a
            newer version.
    """
    recording = find_recording(path)
    if recording is None:
        raise UnreadableFile(path, "neither the file nor its log exists")
    with unreadable(recording.log), contextlib.ExitStack() as opened:
        rows = opened.enter_context(
            contextlib.closing(RowLogReader(recording.log, recording.dtype.itemsize))
        )
        count = rows.count
        # Look it up again, because a later recording may have begun in the meantime.
        recording = find_recording(path) or recording
        if recording.stop is not None:
            # All of its rows were counted before its end was recorded.
            count = rows.count
        return _reader_of(recording, count, rows, path, opened)


def _reader_of(
    recording: Recording,
    count: int,
    rows: RowLogReader,
    path: Path,
    opened: contextlib.ExitStack,
) -> TrajectoryReader:
    log, dtype = recording.log, recording.dtype
    first, stop = recording.row, recording.stop
    if stop is None:
        # A recording without an end event extends to the next recording, if any.
        stop = count if recording.following is None else recording.following
    stop = max(first, min(stop, count))
    rewards, flags = _sound_heads(rows, dtype, first, stop)
    is_step, is_frame = flags & STEP != 0, flags & FRAME != 0
    steps = _places(first, is_step)
    places = {
        **dict.fromkeys(("state", "observation"), steps),
        # The row of step k has the action that led to it. The reset's row has none.
        "action": steps[1:],
        "snapshot": _places(first, is_frame),
    }
    numbers = np.cumsum(is_step)
    numbers -= 1
    last = int(np.flatnonzero(is_step | is_frame).max(initial=-1))
    looks = _open_looks(recording, opened)
    changes = list(_find_changes(looks, recording.look, first + last + 1))

    def read(part: str, start: int, stop: int) -> NDArray[Any]:
        with unreadable(log):
            return _read_part(rows, dtype, part, np.array(places[part][start:stop]))

    def read_change(index: int) -> ModelChange:
        assert looks is not None
        step, offset, length = changes[index]
        with unreadable(log.with_suffix(LOOKS)):
            fields = _unpack_fields(os.pread(looks.fileno(), length, offset))
            return ModelChange(step=step, fields=fields)

    endings = flags[is_step][1:]
    expected = stop if recording.stop is None else max(stop, recording.stop)
    return TrajectoryReader(
        path=path,
        facts=dict(recording.facts),
        dtype=dtype,
        row_count=int(is_step.sum()),
        rewards=rewards[is_step][1:],
        terminated=endings & TERMINATED != 0,
        truncated=endings & TRUNCATED != 0,
        frame_steps=numbers[is_frame],
        change_count=len(changes),
        dropped=max(0, expected - first) - len(flags),
        read=read,
        read_change=read_change,
        release=opened.pop_all().close,
    )


def _places(first: int, is_part: NDArray[np.bool_]) -> Sequence[int] | NDArray[np.intp]:
    """Return the numbers of the rows with a part, in little memory if all have it."""
    if is_part.all():
        return range(first, first + len(is_part))
    return first + np.flatnonzero(is_part)


def _sound_heads(
    rows: RowLogReader, dtype: np.dtype[Any], first: int, stop: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return rewards and flags of the rows from `first` to the first invalid row."""
    at_once = max(1, _CHUNK_BYTES // dtype.itemsize)
    rewards, flags = [np.empty(0)], [np.empty(0, np.uint8)]
    steps = 0
    for start in range(first, stop, at_once):
        found = rows.read(start, min(stop, start + at_once)).view(dtype)[:, 0]
        numbers = steps + np.cumsum(found["flags"] & STEP != 0)
        sound = found["row"] == np.arange(start, start + len(found))
        sound &= found["flags"] & _KINDS != 0
        # States, actions and frames are matched by their positions.
        sound &= found["step"] == numbers - 1
        if not sound.all():
            # A log may have a hole after its rows.
            found = found[: np.argmin(sound)]
        rewards.append(found["reward"].copy())
        flags.append(found["flags"].astype(np.uint8))
        if len(found) < len(sound):
            break
        steps = numbers[-1]
    return np.concatenate(rewards), np.concatenate(flags)


def _read_part(
    rows: RowLogReader, dtype: np.dtype[Any], part: str, wanted: NDArray[np.intp]
) -> NDArray[Any]:
    member = dtype[part]
    out = np.zeros((len(wanted), *member.shape), member.base)
    at_once = max(1, _CHUNK_BYTES // dtype.itemsize)
    start = 0
    while start < len(wanted):
        # Rows between the requested rows are read too.
        stop = int(np.searchsorted(wanted, wanted[start] + at_once))
        chosen = wanted[start:stop]
        first, behind = int(chosen[0]), int(chosen[-1]) + 1
        found = rows.read(first, behind).view(dtype)[:, 0]
        if (found["row"] != np.arange(first, behind)).any():
            raise ValueError("its log was changed while being read")
        values = found[part][chosen - first]
        # Copy member by member, because the padding between members contains data.
        for name in member.names or ():
            out[name][start:stop] = values[name]
        if member.names is None:
            out[start:stop] = values
        start = stop
    return out


def _open_looks(recording: Recording, opened: contextlib.ExitStack) -> BinaryIO | None:
    try:
        return opened.enter_context(open_regular(recording.log.with_suffix(LOOKS)))
    except FileNotFoundError:
        # If the whole log was removed, this raises an error, because the log is removed
        # before its `.looks` file.
        recording.log.lstat()
        return None


def _find_changes(
    looks: BinaryIO | None, offset: int, stop: int
) -> Iterator[tuple[int, int, int]]:
    """Yield the step, offset and length of each change before row `stop`."""
    if looks is None:
        return
    size = os.fstat(looks.fileno()).st_size
    while offset + _CHANGE.size <= size:
        prefix = os.pread(looks.fileno(), _CHANGE.size, offset)
        row, step, length = _CHANGE.unpack(prefix)
        offset += _CHANGE.size
        if row >= stop or not 0 < length <= min(_LARGEST_CHANGE, size - offset):
            return
        yield step, offset, length
        offset += length


def pack_change(row: int, change: ModelChange) -> bytes:
    """Return the `.looks` record for a model change that takes effect at `row`.

    Raises:
        InvalidArgument: a field is not an array of plain numbers, its name is invalid,
            or the change is too large.
    """
    arrays = {name: np.asarray(values) for name, values in change.fields.items()}
    record = np.empty(
        (),
        [(n, each.dtype.newbyteorder("<"), each.shape) for n, each in arrays.items()],
    )
    try:
        check_dtype(record.dtype)
    except ValueError as error:
        raise InvalidArgument(f"A model field cannot be recorded: {error}.") from None
    for name, array in arrays.items():
        record[name] = array
    file = io.BytesIO()
    np.lib.format.write_array(file, record, (1, 0), allow_pickle=False)
    packed = file.getvalue()
    if len(packed) > _LARGEST_CHANGE:
        raise InvalidArgument(
            f"A change to a model may have at most {_LARGEST_CHANGE} bytes, but this "
            f"one has {len(packed)}."
        )
    return _CHANGE.pack(row, change.step, len(packed)) + packed


def _unpack_fields(packed: bytes) -> dict[str, NDArray[Any]]:
    try:
        record = np.lib.format.read_array(
            io.BytesIO(packed), allow_pickle=False, max_header_size=_LONGEST_HEADER
        )
        check_dtype(record.dtype)
        # Copies are writable, and do not keep the whole record alive.
        return {name: record[name].copy() for name in record.dtype.names or ()}
    # NumPy parses the header as Python code, which may raise any error.
    except Exception as error:
        raise ValueError(f"a change to the model is damaged ({error})") from error

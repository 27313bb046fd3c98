# SPDX-License-Identifier: Apache-2.0
"""Reading a recording in flight: of a living process, a dead one, an ended one.

Rows count as far as each says its own number: after a crash of the machine the pages of
a log may be there without what was written into them.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import ClosedError
from .in_flight import get_recording, read_list
from .json_fields import unreadable
from .model_changes import LARGEST_CHANGE, unpack_change
from .regular_files import open_regular
from .row_log import RowLogReader
from .span_writer import LOOK_PREFIX
from .spans import (
    FRAME,
    LOOKS,
    STEP,
    TERMINATED,
    TRUNCATED,
    Recording,
    SpanList,
    row_dtype,
)
from .trajectory import ModelChange, TrajectoryReader

# A row has a step, a frame, or both.
_KINDS = STEP | FRAME
_HEAD = np.dtype([("step", "<i8"), ("reward", "<f8"), ("flags", "<u8")])

# Read at once while looking through the rows.
_CHUNK_BYTES = 1 << 22


class SpanReader(TrajectoryReader):
    """Reads what a log holds of a recording at the moment of opening.

    Args:
        path: the file that the recording will be.

    Raises:
        UnreadableFile: there is no such recording, or its log is damaged, or of a newer
            version.
    """

    _log_rows: RowLogReader | None = None
    _looks: BinaryIO | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        recording = get_recording(path)
        spans = recording.spans
        assert spans.header is not None
        self._log = spans.log
        self._dtype = row_dtype(spans.header)
        with unreadable(spans.log), contextlib.ExitStack() as opened:
            self._log_rows = RowLogReader(spans.log, self._dtype.itemsize)
            opened.callback(self.close)
            count = self._log_rows.count
            # Again: what was begun behind it is not its own.
            known = read_list(spans.path).recordings
            recording = replace(known.get(recording.name, recording))
            if recording.stop is not None:
                # All of its rows were counted when that was said.
                count = self._log_rows.count
            self.header = replace(spans.header, facts=dict(recording.facts))
            self._first = recording.row
            self._look_through(_stop_of(recording, count), recording.stop)
            self._looks = self._open_looks(recording.spans)
            self._changes = list(self._find_changes(recording))
            self.change_count = len(self._changes)
            opened.pop_all()

    def close(self) -> None:
        """Close the log; idempotent. What is in memory stays."""
        if self._log_rows is not None:
            self._log_rows.close()
            self._log_rows = None
        if self._looks is not None:
            self._looks.close()
            self._looks = None

    def _look_through(self, stop: int, promised: int | None) -> None:
        """Find the steps and frames in the rows before `stop`.

        Args:
            stop: behind the last row that is there.
            promised: behind the last that was written; None where that is not known.
        """
        at_once = max(1, _CHUNK_BYTES // self._dtype.itemsize)
        parts, whole = [np.empty(0, _HEAD)], 0
        for start in range(self._first, stop, at_once):
            rows = self._read(start, min(stop, start + at_once))
            numbers = np.arange(start, start + len(rows))
            sound = (rows["row"] == numbers) & (rows["flags"] & _KINDS != 0)
            count = len(rows) if sound.all() else int(np.argmin(sound))
            part = np.empty(count, _HEAD)
            for name in part.dtype.names or ():
                part[name] = rows[name][:count]
            parts.append(part)
            whole += count
            if count < len(rows):
                break
        taken = self._take_heads(np.concatenate(parts))
        self.dropped = max(0, stop - self._first, (promised or 0) - self._first) - taken

    def _take_heads(self, heads: NDArray[Any]) -> int:
        """Take over what the heads of rows say, and return of how many they are."""
        is_step = heads["flags"] & STEP != 0
        # States, actions and frames belong together by their places.
        in_order = heads["step"] == np.cumsum(is_step) - 1
        if not in_order.all():
            heads = heads[: np.argmin(in_order)]
            is_step = is_step[: len(heads)]
        flags, is_frame = heads["flags"], heads["flags"] & FRAME != 0
        # Where they stand, from the first row of the recording on.
        self._step_rows = np.flatnonzero(is_step)
        self._frame_rows = np.flatnonzero(is_frame)
        self.row_count = len(self._step_rows)
        # The row of the reset has none.
        self.rewards = heads["reward"][is_step][1:].copy()
        self.terminated = (flags[is_step] & TERMINATED != 0)[1:]
        self.truncated = (flags[is_step] & TRUNCATED != 0)[1:]
        self.frame_steps = heads["step"][is_frame]
        return len(heads)

    def _rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        column = name.removesuffix("s")
        if column == "snapshot":
            rows = self._column(column, self._frame_rows[start:stop])
            # Padding holds whatever lies between MuJoCo's arrays.
            rows[:, self.header.snapshot.padding] = 0
            return rows
        # The row of step k has the action that led there; that of the reset has none.
        later = column == "action"
        return self._column(column, self._step_rows[start + later : stop + later])

    def _column(self, name: str, wanted: NDArray[np.intp]) -> NDArray[Any]:
        member = self._dtype[name]
        out = np.empty((len(wanted), *member.shape), member.base)
        at_once = max(1, _CHUNK_BYTES // self._dtype.itemsize)
        start = 0
        while start < len(wanted):
            # What stands between those that are wanted is read, too.
            stop = int(np.searchsorted(wanted, wanted[start] + at_once))
            part = wanted[start:stop] + self._first
            first, last = int(part[0]), int(part[-1])
            with unreadable(self._log):
                rows = self._read(first, last + 1)
                if (rows["row"] != np.arange(first, last + 1)).any():
                    raise ValueError("its log was changed while it was read")
            out[start:stop] = rows[name][part - first]
            start = stop
        return out

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        if self._log_rows is None:
            raise self._closed()
        return self._log_rows.read(start, stop).view(self._dtype)[:, 0]

    def _open_looks(self, spans: SpanList) -> BinaryIO | None:
        try:
            return open_regular(spans.looks)
        except FileNotFoundError:
            # All files of a log are removed, and that before this one.
            spans.log.lstat()
            return None

    def _find_changes(self, recording: Recording) -> Iterator[tuple[int, int]]:
        """Yield where the changes of the model are in their file, and how long."""
        if self._looks is None:
            return
        last = [int(r[-1]) for r in (self._step_rows, self._frame_rows) if len(r)]
        stop = self._first + max(last, default=-1) + 1
        file = self._looks.fileno()
        size, offset = os.fstat(file).st_size, recording.look
        while offset + LOOK_PREFIX.size <= size:
            prefix = os.pread(file, LOOK_PREFIX.size, offset)
            if len(prefix) < LOOK_PREFIX.size:
                return
            row, length = LOOK_PREFIX.unpack(prefix)
            offset += LOOK_PREFIX.size
            if row >= stop or not 0 < length <= min(LARGEST_CHANGE, size - offset):
                return
            yield offset, length
            offset += length

    def _model_change(self, index: int) -> ModelChange:
        offset, length = self._changes[index]
        if self._looks is None:
            raise self._closed()
        with unreadable(self._log.with_suffix(LOOKS)):
            return unpack_change(os.pread(self._looks.fileno(), length, offset))

    def _closed(self) -> ClosedError:
        return ClosedError(f"The trajectory {self.path} is closed.")


def _stop_of(recording: Recording, count: int) -> int:
    """Return the row behind the last of a recording, of `count` in the log."""
    if recording.stop is not None:
        return max(recording.row, min(recording.stop, count))
    # One that was left without an end is followed by the next one, if there is any.
    names = list(recording.spans.recordings)
    following = names[names.index(recording.name) + 1 :]
    if not following:
        return count
    return min(count, recording.spans.recordings[following[0]].row)

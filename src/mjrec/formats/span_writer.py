# SPDX-License-Identifier: Apache-2.0
"""Writers for a monitor's recordings, which go into row logs one after another.

A log is used for more recordings as long as their rows have the same layout and the log
is not too long. When a call that writes a row or a journal line returns, the operating
system has the data. Therefore, a killed process loses nothing, and no flush is needed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..atomic_files import writing
from ..errors import DirectoryNotWritable, FileNotWritten
from .bundle import FINISHED
from .journal import JournalWriter
from .monitor_directory import log_name
from .row_log import TAIL_BYTES, RowLog
from .spans import LOOKS, Recording, remove_log
from .trajectory import (
    FORMAT_VERSION,
    FRAME,
    HEAD_WORDS,
    STEP,
    TERMINATED,
    TRUNCATED,
    ModelChange,
)
from .trajectory_log import pack_change

# If the log is larger than this, the next recording begins a new log.
_LONG = 64 << 20
# To find one recording, all recordings in its log are read, so their number is limited.
_MANY = 256

# The tail of a log with a single recording is smaller by this factor, because creating
# it takes longer than everything else at the start of an episode.
_TAILS_OF_ONE = 8

ROW_HEAD = struct.Struct("=qqdQ")


class SpanLogs:
    """The row logs of one monitor, which are written one at a time.

    Args:
        directory: the monitor directory.
        infix: the monitor's infix.
        journal: the monitor's journal, which records the rows of each recording.
        numbers: an iterator that numbers the logs, shared by all of a monitor's logs.
        tail_bytes: size of each log's tail in bytes.
    """

    def __init__(
        self,
        directory: Path,
        infix: str,
        *,
        journal: JournalWriter,
        numbers: Iterator[int],
        tail_bytes: int = TAIL_BYTES,
    ) -> None:
        self.directory = directory
        self._infix = infix
        self._journal = journal
        self._numbers = numbers
        self._tail_bytes = tail_bytes
        self._log: OpenLog | None = None
        self._said: _Rows | None = None

    def path_of(self, name: str) -> Path:
        """Return the path of the file that an episode's recording will become."""
        return self.directory / f"{name}{FINISHED}"

    def begin(
        self,
        name: str,
        facts: Mapping[str, Any],
        dtype: np.dtype[Any],
        *,
        alone: bool = False,
    ) -> SpanWriter:
        """Begin a recording.

        Args:
            name: the recording's file name, without suffix.
            facts: the facts known so far.
            dtype: the dtype of its rows, from `row_dtype`.
            alone: whether the recording gets a log of its own, which is removed
                together with the recording.

        Raises:
            FileNotWritten: the disk is full, or the directory was removed.
        """
        if self._log is not None and (alone or not self._log.suits(dtype)):
            self.close()
        if self._log is None:
            number = next(self._numbers)
            path = self.directory / log_name(self._infix, number)
            tail = self._tail_bytes // _TAILS_OF_ONE if alone else self._tail_bytes
            self._log = OpenLog(path, number, dtype, self._journal, tail_bytes=tail)
        log = self._log
        try:
            # Create the log before the journal mentions it, because a recording without
            # a log counts as gone.
            said = self._say_rows(log.number, dtype, facts)
            line = _begin(log, name, facts, said)
            self._journal.note("begin", line, later=False)
        except FileNotWritten:
            if not log.recordings:
                self._log = None
                log.remove()
            raise
        log.is_alone = alone
        return SpanWriter(log, name, facts)

    def close(self) -> None:
        """Write the rows that are not in the log yet, and close the log. Idempotent.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        if self._log is not None:
            self._log.close()
            self._log = None

    def release(self) -> None:
        """Close the log's files without changing them."""
        if self._log is not None:
            self._log.release()
            self._log = None

    def _say_rows(
        self, number: int, dtype: np.dtype[Any], facts: Mapping[str, Any]
    ) -> _Rows:
        """Record the layout of rows, unless the journal already contains it."""
        said, lost = self._said, self._journal.lost
        if said is not None and said.lost == lost and said.dtype == dtype:
            return said
        line = {"number": number, "version": FORMAT_VERSION, "dtype": dtype.descr}
        self._journal.note("rows", {**line, "facts": dict(facts)}, later=False)
        self._said = _Rows(number, lost, dtype, facts)
        return self._said


class _Rows(NamedTuple):
    """The rows event in the journal, and the number of journals lost before it."""

    number: int
    lost: int
    dtype: np.dtype[Any]
    facts: Mapping[str, Any]


def _begin(
    log: OpenLog, name: str, facts: Mapping[str, Any], rows: _Rows
) -> dict[str, Any]:
    """Return the facts for a begin event, leaving out those in the rows event."""
    known = rows.facts
    own = {
        key: value
        for key, value in facts.items()
        # Most values are identical objects in each recording.
        if key not in known or (known[key] is not value and known[key] != value)
    }
    line = {"name": name, "log": log.number, "rows": rows.number}
    line |= {"row": log.count, "look": log.look_size, "facts": own}
    without = [key for key in known if key not in facts]
    return {**line, **({"without": without} if without else {})}


class OpenLog(RowLog):
    """A row log that contains recordings and the changes to their model.

    Attributes:
        number: the log's number.
        journal: the monitor's journal.
        columns: views of the tail's slots by part: `state` as float64, `snapshot` as
            words, `action` and `observation`. Parts that the rows lack are missing.
        bodies: for each slot, all words after its head.
        is_alone: whether the log is for a single recording and is closed with it.
        look_size: size in bytes of all changes to the model so far.
        recordings: all recordings that were begun in this log.
    """

    def __init__(
        self,
        path: Path,
        number: int,
        dtype: np.dtype[Any],
        journal: JournalWriter,
        *,
        tail_bytes: int,
    ) -> None:
        super().__init__(path, dtype.itemsize // 8, tail_bytes=tail_bytes)
        self.number, self.journal = number, journal
        self.is_alone = False
        self.look_size = 0
        # There are only a few. Reading them from the journal would take time and
        # memory.
        self.recordings: list[Recording] = []
        self._dtype = dtype
        self._looks: int | None = None
        slots = self.slots
        self.bodies = [slots[k, HEAD_WORDS:] for k in range(self.capacity)]
        self.columns: dict[str, NDArray[Any]] = {}
        for name, (kind, offset, *_) in (dtype.fields or {}).items():
            words = slots[:, offset // 8 : (offset + kind.itemsize) // 8]
            whole = {"state": words.view(np.float64), "snapshot": words}
            self.columns[name] = whole.get(name, slots.view(dtype)[:, 0][name])

    def suits(self, dtype: np.dtype[Any]) -> bool:
        """Return whether a recording with this row layout can continue in this log."""
        size = self.count * self.row_size + self.look_size
        return (
            size < _LONG
            and len(self.recordings) < _MANY
            and self._dtype == dtype
            and not self.is_alone
            and self.is_open
            # The file has not been removed.
            and os.fstat(self._log).st_nlink > 0
        )

    def add_change(self, change: ModelChange) -> None:
        """Add a change to the model that takes effect at the next row.

        Raises:
            InvalidArgument: the change cannot be recorded.
            FileNotWritten: the disk is full; nothing was added.
        """
        record = pack_change(self.count, change)
        path = self.path.with_suffix(LOOKS)
        with writing(path):
            if self._looks is None:
                self._looks = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
            if os.pwrite(self._looks, record, self.look_size) != len(record):
                os.ftruncate(self._looks, self.look_size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.look_size += len(record)

    def close(self) -> None:
        """Write the last rows, and remove the log if nothing is in flight. Idempotent.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        if not self.is_open:
            return
        try:
            self.write()
            self.journal.note("full", self.number, later=False)
        except FileNotWritten:
            if not self.path.exists():
                # The directory was removed, so there is nothing to retry.
                self.release()
            raise
        super().close()
        if not any(recording.is_in_flight for recording in self.recordings):
            # Otherwise the finisher removes the files.
            self.remove()

    def remove(self) -> None:
        """Close the files and remove them."""
        self.release()
        with contextlib.suppress(DirectoryNotWritable):
            remove_log(self.path)

    def release(self) -> None:
        """Close the files unchanged. Idempotent."""
        super().release()
        self.bodies, self.columns = [], {}
        if self._looks is not None:
            os.close(self._looks)
            self._looks = None


class SpanWriter:
    """A writer for one recording.

    Args:
        log: the log for its rows.
        name: the recording's file name, without suffix.
        facts: the facts known so far.

    Attributes:
        log: the log for the rows.
        steps: the number of the last step; 0 before the first step.
        frame_count: number of frames so far.
        last_frame: the step of the last frame; -1 before the first frame.
    """

    def __init__(self, log: OpenLog, name: str, facts: Mapping[str, Any]) -> None:
        self.log = log
        self._name = name
        own = {key: facts[key] for key in ("kept", "video") if key in facts}
        row, look = log.count, log.look_size
        self._recording = Recording(name, log.path, {}, own, row=row, look=look)
        log.recordings.append(self._recording)
        self.steps = self.frame_count = 0
        self.last_frame = -1

    def make_room(self) -> int:
        """Return the slot for the next row.

        Raises:
            FileNotWritten: the disk is full; all rows so far are kept.
        """
        rows = self.log
        if rows.count >= rows.limit:
            rows.make_room()
        return rows.count % rows.capacity

    def commit(
        self,
        step: int,
        reward: float = 0.0,
        *,
        is_step: bool = True,
        is_frame: bool = False,
        terminated: bool = False,
        truncated: bool = False,
    ) -> None:
        """Mark the row that was just filled as complete.

        Args:
            step: 0 for the reset, which has no reward and no action; then 1, 2, 3 ...
            reward: the step's reward.
            is_step: whether the row has the step's state, action and observation.
            is_frame: whether the row has a snapshot for a frame.
            terminated: whether the task ended the episode.
            truncated: whether a limit outside the task ended the episode.

        Raises:
            FileNotWritten: the disk is full, and rows are written one by one. The row
                is kept, and later calls retry.
        """
        rows = self.log
        flags = (STEP if is_step else 0) | (FRAME if is_frame else 0)
        flags |= (TERMINATED if terminated else 0) | (TRUNCATED if truncated else 0)
        head = rows.slots[rows.count % rows.capacity, :HEAD_WORDS]
        ROW_HEAD.pack_into(head.data.cast("B"), 0, rows.count, step, reward, flags)
        # Do not call anything between these statements: a signal handler can run after
        # any call and raise, but the count must match the rows.
        rows.counter[0] = rows.count = rows.count + 1
        if is_step:
            self.steps = step
        if is_frame:
            self.last_frame = step
            self.frame_count += 1
        rows.settle()

    def note(self, facts: Mapping[str, Any]) -> None:
        """Add facts, even after the recording's end. Newer facts replace older ones.

        Raises:
            FileNotWritten: the disk is full; the facts will be written before the
                journal's next line.
        """
        self.log.journal.note("note", {"name": self._name, "facts": dict(facts)})

    def end(self, facts: Mapping[str, Any]) -> None:
        """Record how the recording ended, and close its log if it is not shared.

        Raises:
            FileNotWritten: the disk is full; the event will be written before the
                journal's next line.
        """
        said = {"name": self._name, "row": self.log.count, "facts": dict(facts)}
        self.log.journal.note("end", said)
        if self.log.is_alone:
            self.log.close()

    def drop(self) -> None:
        """Discard the recording's rows, and remove its log if it is not shared.

        Raises:
            FileNotWritten: the disk is full; the event will be written before the
                journal's next line.
        """
        if self.log.is_alone:
            # Remove the log first, because the disk may be full.
            self.log.remove()
        self._recording.is_dropped = True
        self.log.journal.note("drop", self._name)

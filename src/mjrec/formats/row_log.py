# SPDX-License-Identifier: Apache-2.0
"""An append-only log of fixed-size rows that survives SIGKILL without being flushed.

New rows go into the tail, a small file next to the log that is mapped into the writer's
memory. Row i is filled in place, in slot `i % capacity`, in pages that stay cached. A
reader needs only one aligned 64-bit counter, which is incremented when a row is
complete. A full tail is written to the log, where row i begins at byte `i * row_size`,
before a slot is reused. So at any time, every row is in one of the two files.

The tail file begins with a page of 64-bit words: the counter, the number of words per
row, and the number of slots. Closing the log writes its last rows and removes the tail.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import struct
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic_files import writing
from .regular_files import open_regular

TAIL_BYTES = 256 << 10
_LEAST_ROWS = 4
TAIL_HEAD = 4096
_TAIL = ".tail"

# The statfs(2) types of ext4, XFS, tmpfs and overlayfs, where the content of a mapped
# page outlives the process. Some other file systems (network, FUSE, copy-on-write) lose
# pages, or raise SIGBUS on a full disk. There, each row is written immediately.
_MAPPABLE = frozenset((0xEF53, 0x58465342, 0x01021994, 0x794C7630))


class RowLog:
    """A writer for a row log.

    Args:
        path: the log; neither it nor its tail may exist.
        row_words: number of 64-bit words in a row.
        tail_bytes: size of the tail in bytes; at least four rows always fit.

    Attributes:
        path: the log.
        count: number of rows so far.
        slots: the tail, `(capacity, row_words) uint64`. After `make_room`, fill row
            `count` in `slots[count % capacity]`, then increase `counter[0]` and `count`
            by 1.
        memory: the bytes of the tail file: `TAIL_HEAD` bytes, then the slots.
        counter: the words of the tail's head; `counter[0]` is the number of rows so
            far, for readers.
        limit: call `make_room` before filling row `limit`.

    Raises:
        FileNotWritten: the disk has no room for the tail, or the directory was removed.
    """

    def __init__(
        self, path: Path, row_words: int, *, tail_bytes: int = TAIL_BYTES
    ) -> None:
        self.path = path
        self.row_size = 8 * row_words
        self.capacity = max(_LEAST_ROWS, tail_bytes // self.row_size)
        self.count = self._written = 0
        length = TAIL_HEAD + self.capacity * self.row_size
        with writing(path):
            self._log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
            try:
                self._is_mapped = _may_be_mapped(self._log)
                self.memory = self._new_memory(length)
            except BaseException:
                os.close(self._log)
                path.unlink(missing_ok=True)
                raise
        self.limit = self.capacity if self._is_mapped else 0
        self.counter = memoryview(self.memory).cast("Q")
        self.counter[1], self.counter[2] = row_words, self.capacity
        rows = np.frombuffer(self.memory, np.uint64, offset=TAIL_HEAD)
        self.slots: NDArray[np.uint64] = rows.reshape(self.capacity, row_words)

    def make_room(self) -> None:
        """Write the rows that are not in the log yet, so that the next slot is free.

        Raises:
            FileNotWritten: the disk is full; all rows so far are kept.
        """
        self.write()
        self.limit = self.count + (self.capacity if self._is_mapped else 0)

    def settle(self) -> None:
        """Write the complete rows to the log if no tail file preserves them.

        Raises:
            FileNotWritten: the disk is full; the rows stay in memory.
        """
        if not self._is_mapped:
            self.write()

    @property
    def is_open(self) -> bool:
        """Whether rows can be added."""
        return self._log >= 0

    def close(self) -> None:
        """Write the last rows and remove the tail. Idempotent.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        if not self.is_open:
            return
        self.write()
        self.release()
        with contextlib.suppress(OSError):
            # A leftover tail is harmless, because all of its rows are in the log.
            tail_path(self.path).unlink()

    def release(self) -> None:
        """Close the files as they are. Idempotent."""
        if self.is_open:
            os.close(self._log)
            self._log = -1
            # A reference to this object must not keep the mapping and its file alive.
            del self.slots, self.counter, self.memory

    def write(self) -> None:
        """Write the rows that are not in the log yet.

        Raises:
            FileNotWritten: the disk is full; the rows stay in memory.
        """
        with writing(self.path):
            while self._written < self.count:
                first = self._written % self.capacity
                stop = min(self.capacity, first + self.count - self._written)
                _write_all(
                    self._log,
                    self.slots[first:stop].reshape(-1).view(np.uint8).data,
                    self._written * self.row_size,
                )
                self._written += stop - first

    def _new_memory(self, length: int) -> mmap.mmap:
        if not self._is_mapped:
            return mmap.mmap(-1, length)
        path = tail_path(self.path)
        tail = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            # Make a full disk raise an error here, instead of a SIGBUS when a page is
            # touched.
            os.posix_fallocate(tail, 0, length)
            return mmap.mmap(tail, length)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(tail)


def tail_path(log: Path) -> Path:
    """Return the path of a log's tail."""
    return log.with_suffix(_TAIL)


def has_rows(log: Path) -> bool:
    """Return whether a log, or its tail, has rows."""
    if log.stat().st_size:
        return True
    with contextlib.suppress(FileNotFoundError), open_regular(tail_path(log)) as tail:
        return any(tail.read(8))
    return False


class RowLogReader:
    """A reader for a row log that may still be in use, or whose writer was killed.

    Args:
        path: the log.
        row_size: number of bytes in a row.

    Raises:
        OSError: the log does not exist or cannot be read.
    """

    def __init__(self, path: Path, row_size: int) -> None:
        self._row_size = row_size
        with contextlib.ExitStack() as opened:
            # Open the tail first: if the writer closes now, the log has all rows.
            self._tail = self._capacity = 0
            with contextlib.suppress(FileNotFoundError):
                tail = opened.enter_context(open_regular(tail_path(path)))
                self._tail, self._capacity = tail.fileno(), self._room_in(tail.fileno())
            self._log = opened.enter_context(open_regular(path)).fileno()
            self._opened = opened.pop_all()

    @property
    def count(self) -> int:
        """Number of rows so far."""
        counted, in_log = self._counted(), self._in_log()
        # The log lacks only rows that fit into the tail, so a larger count is wrong.
        return max(in_log, min(counted, in_log + self._capacity))

    def read(self, start: int, stop: int) -> NDArray[np.uint8]:
        """Return rows `start` to `stop`, `(stop - start, row_size) uint8`.

        Raises:
            ValueError: some of the rows are missing because the log was truncated.
        """
        rows = np.empty((stop - start, self._row_size), np.uint8)
        done = self._read_log(start, rows)
        while done < len(rows):
            first = start + done
            found = self._read_tail(first, rows[done:])
            # The rows of slots that were reused in the meantime are now in the log.
            lost = max(0, self._counted() + 1 - self._capacity - first)
            if lost and self._in_log() > first:
                done += self._read_log(first, rows[done:])
            elif found:
                done += found
            else:
                raise ValueError("its last rows are missing")
        return rows

    def close(self) -> None:
        """Close the files. Idempotent."""
        self._opened.close()

    def _room_in(self, tail: int) -> int:
        """Return the number of slots in a tail, or 0 if it is not this log's tail."""
        page = os.pread(tail, 24, 0)
        words, capacity = (
            struct.unpack_from("=QQ", page, 8) if len(page) == 24 else (0, 0)
        )
        length = os.fstat(tail).st_size
        is_sound = (
            8 * words == self._row_size
            and TAIL_HEAD + capacity * self._row_size <= length
        )
        return capacity if is_sound else 0

    def _counted(self) -> int:
        if not self._capacity:
            return 0
        return int.from_bytes(os.pread(self._tail, 8, 0), byteorder=sys.byteorder)

    def _in_log(self) -> int:
        return os.fstat(self._log).st_size // self._row_size

    def _read_log(self, start: int, out: NDArray[np.uint8]) -> int:
        """Fill rows from the log, and return the number of complete rows read."""
        left = out.reshape(-1).data
        offset = start * self._row_size
        while left and (count := os.preadv(self._log, [left], offset)):
            left, offset = left[count:], offset + count
        return (offset - start * self._row_size) // self._row_size

    def _read_tail(self, start: int, out: NDArray[np.uint8]) -> int:
        """Fill rows from the tail up to its end, and return the number of rows read."""
        if not self._capacity:
            return 0
        slot = start % self._capacity
        part = out[: self._capacity - slot]
        os.preadv(
            self._tail, [part.reshape(-1).data], TAIL_HEAD + slot * self._row_size
        )
        return len(part)


def _may_be_mapped(descriptor: int) -> bool:
    # `os.statvfs` does not return the type, which is the C struct's first member.
    found = (ctypes.c_long * 64)()
    failed = ctypes.CDLL(None).fstatfs(descriptor, found)
    return not failed and found[0] in _MAPPABLE


def _write_all(descriptor: int, data: memoryview, offset: int) -> None:
    while data:
        count = os.pwrite(descriptor, data, offset)
        data, offset = data[count:], offset + count

# SPDX-License-Identifier: Apache-2.0
"""A row log keeps every counted row, whatever becomes of the process or the disk."""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import forked, kill_self

import mjrec.formats.row_log as row_log
from mjrec.formats.row_log import TAIL_HEAD, RowLog, RowLogReader, tail_path

WORDS = 4
SIZE = 8 * WORDS
CAPACITY = 8
SMALL = CAPACITY * SIZE


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.states.0.1.000000.log"


@pytest.fixture(params=["a mapped tail", "no tail"])
def mapped(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the file system has mappings that outlive a process."""
    is_mapped = bool(request.param == "a mapped tail")
    monkeypatch.setattr(row_log, "_may_be_mapped", lambda _: is_mapped)
    return is_mapped


def rows(start: int, stop: int, words: int = WORDS) -> np.ndarray:
    """Return what is written as rows: their numbers, and what follows from these."""
    numbers = np.arange(start, stop, dtype=np.uint64)[:, None]
    return numbers * np.arange(1, words + 1, dtype=np.uint64) ** 5


def add(log: RowLog, count: int = 1) -> None:
    """Add rows as recorders do."""
    for _ in range(count):
        if log.count >= log.limit:
            log.make_room()
        words = log.slots.shape[1]
        log.slots[log.count % log.capacity] = rows(log.count, log.count + 1, words)[0]
        log.counter[0] = log.count = log.count + 1
        log.settle()


def check(path: Path, count: int, words: int = WORDS) -> None:
    """Check that a log has exactly the first `count` rows."""
    reader = RowLogReader(path, 8 * words)
    try:
        assert reader.count == count
        found = reader.read(0, count).view(np.uint64)
        np.testing.assert_array_equal(found, rows(0, count, words))
    finally:
        reader.close()


def test_rows_are_there_when_they_are_counted_and_when_all_is_closed(
    path: Path, names: Callable[[Path], list[str]], mapped: bool
) -> None:
    """Wherever the tail wraps, also for an open reader; then there is the log alone."""
    count = 3 * CAPACITY + 5
    log = RowLog(path, WORDS, tail_bytes=SMALL)
    assert tail_path(path).exists() == mapped
    reader = RowLogReader(path, SIZE)
    for number in range(count):
        add(log)
        check(path, number + 1)
        for start in range(number + 1):
            found = reader.read(start, number + 1).view(np.uint64)
            np.testing.assert_array_equal(found, rows(start, number + 1))
    reader.close()
    log.close()
    log.close()
    assert not log.is_open
    check(path, count)
    assert path.read_bytes() == rows(0, count).tobytes()
    assert names(path.parent) == [path.name]


def killed_in_the_middle_of_a_write(log: RowLog) -> None:
    """With some rows of a full tail in the log, and half of one."""
    if log.count == 3 * CAPACITY:
        kill_after_writing(lambda data: data[: len(data) // 2 - 3])


def killed_after_a_write(log: RowLog) -> None:
    """With a full tail in the log, which nobody has taken note of."""
    if log.count == 3 * CAPACITY:
        kill_after_writing(lambda data: data)


def kill_after_writing(part: Callable[[memoryview], memoryview]) -> None:
    real = os.pwrite

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        real(descriptor, part(data), offset)
        kill_self()
        return 0

    os.pwrite = pwrite


def killed_in_the_next_slot(log: RowLog) -> None:
    """When the first slot of a tail that was written is filled again."""
    if log.count == 3 * CAPACITY:
        log.make_room()
        log.slots[0] = 5
        kill_self()


def killed_in_a_close(log: RowLog) -> None:
    """With all rows in the log, before the tail is removed."""
    if log.count == 3 * CAPACITY + 2:
        Path.unlink = kill_self  # type: ignore[method-assign]
        log.close()


MOMENTS = [
    *(killed_in_the_middle_of_a_write, killed_after_a_write),
    *(killed_in_the_next_slot, killed_in_a_close),
]


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_process_loses_no_counted_row(
    path: Path, mapped: bool, moment: Callable[[RowLog], None]
) -> None:
    """At any moment; nothing was flushed, and no signal's handler was called."""

    def record(tell: Callable[[], object]) -> None:
        log = RowLog(path, WORDS, tail_bytes=SMALL)
        while True:
            moment(log)
            add(log)
            tell()

    counted, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert counted >= 3 * CAPACITY
    # Without a tail a row counts as soon as it is in the log.
    is_written = not mapped and moment is killed_after_a_write
    check(path, counted + is_written)


class Interrupt(BaseException):
    """As Ctrl-C raises it."""


@pytest.mark.parametrize("written", [0, 5, SMALL])
def test_an_interrupted_write_is_taken_up_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """After Ctrl-C at any byte of it; each row is there once."""
    log = RowLog(path, WORDS, tail_bytes=SMALL)
    add(log, 2 * CAPACITY)
    real = os.pwrite

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        monkeypatch.undo()
        real(descriptor, data[:written], offset)
        raise Interrupt

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(Interrupt):
        add(log)
    check(path, 2 * CAPACITY)
    add(log, CAPACITY)
    log.close()
    check(path, 3 * CAPACITY)


HEADS = {
    "short": struct.pack("=QQ", 9, WORDS),
    "other rows": struct.pack("=QQQ", 9, WORDS + 1, CAPACITY),
    "beyond its end": struct.pack("=QQQ", 9, WORDS, CAPACITY + 1),
    "no rows": struct.pack("=QQQ", 9, WORDS, 0),
}


@pytest.mark.parametrize("head", HEADS)
def test_a_tail_of_something_else_is_passed_over(path: Path, head: str) -> None:
    """What it says would lead beyond it, or to rows of another size."""
    log = RowLog(path, WORDS)
    add(log, 5)
    log.close()
    size = 16 if head == "short" else TAIL_HEAD + SMALL
    tail_path(path).write_bytes(HEADS[head].ljust(size, b"\0"))
    check(path, 5)

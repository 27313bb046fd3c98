# SPDX-License-Identifier: Apache-2.0
"""The log keeps what was written to it, whatever becomes of the process or the disk."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import gc
import itertools
import os
import random
import signal
import struct
import subprocess
import sys
import threading
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from full_disk import file_size_limit
from trajectories_by_hand import kinds_of
from waiting import wait_until

import mjrec.formats.trajectory_log as trajectory_log
from mjrec.errors import ClosedError, FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats.timely_flushing import flush_in_time
from mjrec.formats.trajectory import (
    Array,
    Field,
    ModelChange,
    RowLayout,
    StateComponent,
    TrajectoryContent,
    TrajectoryHeader,
)
from mjrec.formats.trajectory_log import TrajectoryLogWriter
from mjrec.formats.trajectory_log_reader import TrajectoryLogReader

HEADER = TrajectoryHeader(
    facts={"env_id": "E-v0", "seed": 7, "limit": float("inf")},
    state=(StateComponent("time", 0, 1), StateComponent("qpos", 1, 2)),
    snapshot=RowLayout.packed(
        [
            ("geom_xpos", Array("<f8", (2, 3))),
            ("wrap_obj", Array("<i4", (3,))),
            ("flexvert_xpos", Array("<f8", (0, 3))),
            ("eq_active", Array("|b1", (1,))),
        ]
    ),
    action=Array("<f4", (3,)),
    observation=Array("|u1", (2, 2)),
)
ROW_SIZE = 3 * 8 + 3 * 4 + 4
FRAME_SIZE = HEADER.snapshot.size
STEP_RECORD = 16 + 24 + ROW_SIZE
NAN = struct.pack("<Q", 0x7FF8000000BADBAD)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.trajectory.0.1.episode000027.log"


def step_bytes(step: int) -> bytes:
    return NAN + bytes((step * 7 + i) % 256 for i in range(ROW_SIZE - 8))


def frame_bytes(step: int) -> bytes:
    content = bytes((step * 11 + i) % 256 for i in range(FRAME_SIZE - 9))
    return NAN + content + b"\x01"


@pytest.fixture
def unattended(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread looks after writers: only what the test does is written."""
    monkeypatch.setattr(trajectory_log, "flush_in_time", lambda _, is_open=True: None)


def write_step(writer: TrajectoryLogWriter, step: int, *, frame: bool = True) -> None:
    row = step_bytes(step)
    pieces = (row[:24], bytearray(row[24:36]), memoryview(row)[36:])
    writer.add_step(step, step / 3, step == 8, step == 9, pieces)
    if frame:
        writer.add_frame(step, [frame_bytes(step)])


def write(path: Path, steps: int, *, every: int = 1) -> TrajectoryLogWriter:
    writer = TrajectoryLogWriter(path, HEADER)
    for step in range(steps + 1):
        write_step(writer, step, frame=step % every == 0)
    return writer


def read(path: Path) -> TrajectoryContent:
    with TrajectoryLogReader(path) as reader:
        return reader.content()


def check(content: TrajectoryContent, steps: int, *, every: int = 1) -> None:
    """Check that a log of `steps` steps has exactly what `write` wrote."""
    written = b"".join(step_bytes(step) for step in range(steps + 1))
    rows = np.frombuffer(written, np.uint8).reshape(steps + 1, ROW_SIZE)
    assert content.states.tobytes() == rows[:, :24].tobytes()
    assert content.actions is not None
    assert content.actions.tobytes() == rows[1:, 24:36].tobytes()
    assert content.actions.shape == (steps, 3)
    assert content.observations is not None
    assert content.observations.tobytes() == rows[:, 36:].tobytes()
    assert content.rewards.tolist() == [step / 3 for step in range(1, steps + 1)]
    assert content.terminated.tolist() == [k == 8 for k in range(1, steps + 1)]
    assert content.truncated.tolist() == [k == 9 for k in range(1, steps + 1)]
    frames = range(0, steps + 1, every)
    assert content.frame_steps.tolist() == list(frames)
    assert content.snapshots.tobytes() == b"".join(frame_bytes(k) for k in frames)


def test_everything_comes_back_bit_for_bit(path: Path) -> None:
    """Rows, flags and facts are read as they were written; NaNs keep their payload."""
    write(path, 9, every=3).close()
    content = read(path)
    check(content, 9, every=3)
    assert content.header == HEADER
    assert content.dropped == 0


def test_rows_that_were_written_at_several_times_come_back(path: Path) -> None:
    """What was written in between and what was written last are one sequence."""
    write(path, 2000, every=2).close()
    check(read(path), 2000, every=2)


def test_any_range_can_be_read(path: Path) -> None:
    """Whenever its rows were written."""
    write(path, 1500).close()
    with TrajectoryLogReader(path) as reader:
        for start, stop in [(0, 0), (0, 8), (505, 521), (1022, 1026), (1500, 1501)]:
            expected = b"".join(frame_bytes(step) for step in range(start, stop))
            assert reader.snapshots(start, stop).tobytes() == expected


@pytest.mark.parametrize("bounds", [(-1, 1), (2, 1), (0, 11)])
def test_a_range_that_is_not_there_is_refused(
    path: Path, bounds: tuple[int, int]
) -> None:
    """The error says how many there are."""
    write(path, 9).close()
    with (
        TrajectoryLogReader(path) as reader,
        pytest.raises(InvalidArgument, match="has 10 snapshots"),
    ):
        reader.snapshots(*bounds)


def test_facts_that_come_later_replace_those_before(path: Path) -> None:
    """The newest value of a key counts."""
    writer = write(path, 1)
    writer.add_facts({"rate": "20", "seed": 8})
    writer.flush()
    writer.add_facts({"complete": True, "nan": float("nan")})
    writer.close()
    added = {"rate": "20", "seed": 8, "complete": True, "nan": None}
    assert read(path).header.facts == {**HEADER.facts, **added}


def test_facts_that_json_does_not_know_are_written_as_text(path: Path) -> None:
    """What a user gave as options of a reset never stops a recording."""
    header = TrajectoryHeader(facts={"options": {1, 2}, "seed": np.int64(3)})
    TrajectoryLogWriter(path, header).close()
    assert read(path).header.facts == {"options": [1, 2], "seed": 3}


def test_model_changes_come_back(path: Path) -> None:
    """Names, kinds and values of changed fields, and the step that they hold from."""
    writer = write(path, 1)
    fields = {
        "geom_rgba": np.arange(8, dtype=np.float32).reshape(2, 4),
        "opt.gravity": np.array([0, 0, -9.81]),
        "stat.extent": np.float64(2.5),
        "mat_texid": np.array([[1, 2]], ">i4"),
        "hfield_data": np.empty((0, 3), np.float32),
        "eq_active": np.array([True]),
    }
    writer.add_model_change(ModelChange(step=0, fields=fields))
    writer.add_model_change(ModelChange(step=1, fields={}))
    writer.close()
    first, second = read(path).model_changes
    assert (first.step, second.step, second.fields) == (0, 1, {})
    assert list(first.fields) == list(fields)
    for name, values in fields.items():
        np.testing.assert_array_equal(first.fields[name], values)
        assert first.fields[name].shape == values.shape
        assert first.fields[name].dtype == values.dtype.newbyteorder("<")


def test_records_are_in_the_order_in_which_they_were_added(path: Path) -> None:
    """Torn anywhere, a frame has its step and its model, and the end has every row."""
    writer = write(path, 0)
    writer.add_step(1, 0.5, False, False, [step_bytes(1)])
    writer.add_model_change(ModelChange(step=1, fields={}))
    writer.flush()
    writer.add_frame(1, [frame_bytes(1)])
    writer.moments_of([memoryview(step_bytes(2))], [memoryview(frame_bytes(2))])(2, 1.0)
    writer.add_facts({"complete": True})
    writer.close()
    kinds = [b"head", b"step", b"fram", b"step", b"chng", b"fram", b"step", b"fram"]
    assert kinds_of(path) == [*kinds, b"fact"]


@pytest.mark.usefixtures("unattended")
def test_a_large_model_change_does_not_stay_in_memory(path: Path) -> None:
    """A texture goes to the disk at once."""
    writer = write(path, 1)
    texture = np.zeros(3 << 20, np.uint8)
    writer.add_model_change(ModelChange(step=1, fields={"tex_data": texture}))
    (change,) = read(path).model_changes
    assert change.fields["tex_data"].shape == texture.shape
    writer.close()


@pytest.mark.usefixtures("unattended")
@pytest.mark.parametrize(("size", "told"), [(8, False), (3 << 20, True)])
def test_a_model_change_on_a_full_disk_is_not_lost(
    path: Path, size: int, told: bool
) -> None:
    """Nobody would find it a second time: it is written, once, when there is room."""
    writer = write(path, 9)
    change = ModelChange(step=9, fields={"tex_data": np.zeros(size, np.uint8)})
    with file_size_limit(5000):
        refused = add_until_refused(Memory(writer).add)
        expected = pytest.raises(FileNotWritten) if told else contextlib.nullcontext()
        with expected:
            writer.add_model_change(change)
    writer.close()
    content = read(path)
    check(content, refused - 1)
    assert [len(c.fields["tex_data"]) for c in content.model_changes] == [size]


@pytest.mark.parametrize(
    ("name", "values"), [("a", np.array(["text"])), ("a/b", np.zeros(1))]
)
def test_what_no_file_can_hold_is_refused_as_a_change(
    path: Path, name: str, values: np.ndarray
) -> None:
    """The error names the field; the log goes on."""
    writer = write(path, 3)
    with pytest.raises(InvalidArgument, match=f"The model field '{name}'"):
        writer.add_model_change(ModelChange(step=0, fields={name: values}))
    writer.close()
    check(read(path), 3)


def test_what_no_file_can_hold_is_refused_as_a_row(path: Path) -> None:
    """A layout that a reader would not accept is not written."""
    header = TrajectoryHeader(
        facts={}, snapshot=RowLayout((Field("geom_xpos", Array("<f8", (1,)), 8),))
    )
    with pytest.raises(InvalidArgument, match="geom_xpos is said to begin at 8"):
        TrajectoryLogWriter(path, header)
    with pytest.raises(InvalidArgument, match="'>f8' is no dtype"):
        TrajectoryLogWriter(path, TrajectoryHeader(facts={}, action=Array(">f8", (1,))))


@pytest.mark.parametrize("size", [0, ROW_SIZE - 1, ROW_SIZE + 1])
def test_a_step_of_another_size_is_refused(path: Path, size: int) -> None:
    """The error says what belongs there, nothing is added, and the log goes on."""
    writer = write(path, 3)
    with pytest.raises(InvalidArgument, match=f"has {ROW_SIZE} bytes, not {size}"):
        writer.add_step(4, 0.0, False, False, [bytes(size)])
    write_step(writer, 4)
    writer.close()
    check(read(path), 4)


@pytest.mark.parametrize("size", [0, FRAME_SIZE - 1, FRAME_SIZE + 1])
def test_a_frame_of_another_size_is_refused(path: Path, size: int) -> None:
    """Its step stays, and it can be added again."""
    writer = write(path, 3)
    write_step(writer, 4, frame=False)
    with pytest.raises(InvalidArgument, match=f"has {FRAME_SIZE} bytes, not {size}"):
        writer.add_frame(4, [bytes(size)])
    writer.add_frame(4, [frame_bytes(4)])
    writer.close()
    check(read(path), 4)


@pytest.mark.parametrize(("row", "snapshot"), [(-1, 0), (1, 0), (0, -1), (0, 1)])
def test_memory_of_another_size_is_refused(path: Path, row: int, snapshot: int) -> None:
    """Before the first moment is copied from it."""
    writer = write(path, 3)
    pieces = (
        [memoryview(bytes(ROW_SIZE + row))],
        [memoryview(bytes(FRAME_SIZE + snapshot))],
    )
    with pytest.raises(InvalidArgument, match="row of this log has"):
        writer.moments_of(*pieces)
    writer.close()
    check(read(path), 3)


class Memory:
    """Memory as a simulation's, which is another at every step.

    Args:
        writer: what adds its moments.
    """

    def __init__(self, writer: TrajectoryLogWriter) -> None:
        self.row, self.snapshot = bytearray(ROW_SIZE), bytearray(FRAME_SIZE)
        row, snapshot = memoryview(self.row), memoryview(self.snapshot)
        pieces = (row[:24], row[24:36], row[36:]), (snapshot[:48], snapshot[48:])
        self._add = writer.moments_of(*pieces)

    def add(self, step: int) -> None:
        self.row[:], self.snapshot[:] = step_bytes(step), frame_bytes(step)
        self._add(step, step / 3)


def test_a_moment_is_a_step_with_its_frame(tmp_path: Path) -> None:
    """The file is the same, byte for byte, as where both are added on their own."""
    logs = tmp_path / "moments.log", tmp_path / "rows.log"
    moments, rows = (TrajectoryLogWriter(log, HEADER) for log in logs)
    memory = Memory(moments)
    for step in range(2000):
        memory.add(step)
        rows.add_step(step, step / 3, False, False, [step_bytes(step)])
        rows.add_frame(step, [frame_bytes(step)])
    moments.close()
    rows.close()
    assert logs[0].read_bytes() == logs[1].read_bytes()


def test_a_moment_is_that_at_which_it_was_added(path: Path) -> None:
    """What becomes of the memory before it is written changes nothing."""
    writer = write(path, 0)
    memory = Memory(writer)
    for step in range(1, 4):
        memory.add(step)
    memory.row[:], memory.snapshot[:] = bytes(ROW_SIZE), bytes(FRAME_SIZE)
    writer.close()
    check(read(path), 3)


def test_rows_are_copied_when_they_are_added(path: Path) -> None:
    """Also those that are made of memory which is written over."""
    writer = TrajectoryLogWriter(path, HEADER)
    row, snapshot = bytearray(step_bytes(0)), bytearray(frame_bytes(0))
    writer.add_step(0, 0.0, False, False, [row])
    writer.add_frame(0, [snapshot])
    row[:], snapshot[:] = bytes(ROW_SIZE), bytes(FRAME_SIZE)
    writer.close()
    check(read(path), 0)


def add_until_refused(add: Callable[[int], None]) -> int:
    """Add steps from 10 on where there is no room, and return the refused one's."""
    for step in itertools.count(10):
        try:
            add(step)
        except FileNotWritten:
            return step
        assert step < 100_000
    raise AssertionError


def test_a_moment_that_finds_no_room_was_not_added(path: Path) -> None:
    """Neither its step nor its frame; both can be added again."""
    writer = write(path, 9)
    memory = Memory(writer)
    with file_size_limit(5000):
        refused = add_until_refused(memory.add)
    memory.add(refused)
    writer.close()
    check(read(path), refused)


def test_a_step_that_finds_no_room_was_not_added(path: Path) -> None:
    """All that were added before are there, and it can be added again."""
    writer = write(path, 9)
    with file_size_limit(5000):
        refused = add_until_refused(lambda step: write_step(writer, step, frame=False))
    write_step(writer, refused, frame=False)
    writer.close()
    content = read(path)
    assert content.rewards.tolist() == [step / 3 for step in range(1, refused + 1)]
    assert content.frame_steps.tolist() == list(range(10))


def steps_in(path: Path) -> int:
    """Return how many rows of steps are in a log that may not be there yet."""
    if not path.exists() or path.stat().st_size == 0:
        return 0
    return len(read(path).states)


def test_rows_are_there_within_a_second_though_none_follows(path: Path) -> None:
    """A simulation that hangs after its third step loses nothing by that."""
    writer = write(path, 3)
    wait_until(lambda: steps_in(path) == 4)
    write_step(writer, 4, frame=False)
    wait_until(lambda: steps_in(path) == 5)
    writer.add_frame(4, [frame_bytes(4)])
    writer.close()
    check(read(path), 4)


def test_rows_are_written_when_enough_wait(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By whoever adds more, though none of them has waited for long."""
    monkeypatch.setattr(trajectory_log, "monotonic", lambda: 100.0)
    monkeypatch.setattr(trajectory_log, "_FLUSH_BYTES", 1000)
    writer = write(path, 50)
    assert steps_in(path) > 0
    writer.close()
    check(read(path), 50)


def test_few_rows_are_not_written_at_once(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call of the operating system takes as long as the step of a fast simulation."""
    monkeypatch.setattr(trajectory_log, "monotonic", lambda: 100.0)
    writer = write(path, 50)
    assert not path.exists()
    writer.close()
    check(read(path), 50)


@pytest.mark.usefixtures("unattended")
def test_an_episode_is_written_while_it_runs(path: Path) -> None:
    """Also where no other thread gets its turn: what waits has a bound."""
    writer = write(path, 9)
    for step in range(10, 3000):
        write_step(writer, step)
    assert steps_in(path) > 0
    writer.close()
    check(read(path), 2999)


class Slow:
    """A disk whose next write waits until it is told to go on.

    Args:
        error: what the write ends with; it succeeds where there is none.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, error: OSError | None = None
    ) -> None:
        self.began, self._may_go_on = threading.Event(), threading.Event()
        self._error = error
        self._pwrite, self._monkeypatch = os.pwrite, monkeypatch
        monkeypatch.setattr(os, "pwrite", self._write)

    def go_on(self) -> None:
        self._may_go_on.set()

    def _write(self, *arguments: Any) -> int:
        self._monkeypatch.setattr(os, "pwrite", self._pwrite)
        self.began.set()
        assert self._may_go_on.wait(60)
        if self._error is not None:
            raise self._error
        return self._pwrite(*arguments)


@pytest.mark.usefixtures("unattended")
@pytest.mark.parametrize("error", [None, OSError(errno.ENOSPC, "No space left")])
def test_rows_are_added_while_others_are_written(
    path: Path, monkeypatch: pytest.MonkeyPatch, error: OSError | None
) -> None:
    """The simulation does not wait; all are in their order, whatever came of it."""
    writer = write(path, 3)
    memory = Memory(writer)
    disk = Slow(monkeypatch, error)
    thread = threading.Thread(target=writer.flush_beside)
    thread.start()
    assert disk.began.wait(60)
    for step in range(4, 7):
        memory.add(step)
    write_step(writer, 7)
    disk.go_on()
    thread.join()
    assert steps_in(path) == (4 if error is None else 0)
    write_step(writer, 8)
    writer.close()
    check(read(path), 8)


@pytest.mark.usefixtures("unattended")
def test_a_close_waits_for_what_is_being_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What came after it is behind it in the file."""
    writer = write(path, 3)
    disk = Slow(monkeypatch)
    threads = [
        threading.Thread(target=do) for do in (writer.flush_beside, writer.close)
    ]
    threads[0].start()
    assert disk.began.wait(60)
    write_step(writer, 4)
    threads[1].start()
    assert not writer.closed
    disk.go_on()
    for thread in threads:
        thread.join()
    assert writer.closed
    check(read(path), 4)


@pytest.mark.usefixtures("unattended")
def test_a_full_disk_is_no_error_beside(path: Path) -> None:
    """Nothing is lost: whoever adds rows or closes the log finds out."""
    writer = write(path, 3)
    with file_size_limit(100):
        writer.flush_beside()
        assert steps_in(path) == 0
        write_step(writer, 4)
        with pytest.raises(FileNotWritten):
            writer.flush()
    writer.flush_beside()
    check(read(path), 4)
    writer.close()
    writer.flush_beside()
    check(read(path), 4)


@pytest.mark.usefixtures("unattended")
def test_what_fails_beside_is_written_by_the_next_flush(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever was raised, nothing of it is lost."""
    writer = write(path, 3)

    def fail(*_: object) -> int:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", fail)
        with pytest.raises(MemoryError):
            writer.flush_beside()
    write_step(writer, 4)
    writer.close()
    check(read(path), 4)


class Failing:
    """A writer that cannot be flushed, but for some of the calls."""

    is_due = True

    def __init__(self, *, good: tuple[int, ...] = ()) -> None:
        self.good = good
        self.calls = 0

    def __repr__(self) -> str:
        return "<Failing>"

    def flush_beside(self) -> None:
        self.calls += 1
        if self.calls not in self.good:
            raise MemoryError

    def renew_locks(self) -> None: ...


def test_a_writer_that_fails_does_not_keep_others_from_being_flushed(
    path: Path,
) -> None:
    """The thread goes on."""
    failing = Failing()
    flush_in_time(failing)
    writer = write(path, 3)
    wait_until(lambda: failing.calls > 2)
    wait_until(lambda: path.exists() and steps_in(path) > 0)
    flush_in_time(failing, is_open=False)
    writer.close()
    check(read(path), 3)


def test_that_a_writer_fails_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    """Not at every round of the thread; again where it has not failed in between."""
    failing = Failing(good=(3,))
    flush_in_time(failing)
    wait_until(lambda: failing.calls > 4)
    flush_in_time(failing, is_open=False)
    messages = [record.getMessage() for record in caplog.records]
    assert messages == 2 * ["<Failing> could not be flushed."]


def test_looking_after_writers_ends_with_the_last_of_them(path: Path) -> None:
    """No thread stays; one that was dropped without a close is none of them."""
    writer = write(path, 1)
    names = lambda: [t.name for t in threading.enumerate()]  # noqa: E731
    assert "mjrec-flushing" in names()
    del writer
    gc.collect()
    wait_until(lambda: "mjrec-flushing" not in names())


def wait_for_child(process_id: int) -> None:
    """Wait for the end of a forked process, which may hang."""
    wait_until(lambda: os.waitpid(process_id, os.WNOHANG) != (0, 0))


def test_a_forked_child_can_close_what_is_being_flushed(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another thread was writing when it was forked, and is not there."""
    writer = write(path, 1)
    disk = Slow(monkeypatch)
    thread = threading.Thread(target=writer.flush_beside)
    thread.start()
    assert disk.began.wait(60)
    child = os.fork()
    if child == 0:
        threading.Thread(target=writer.close).start()
        writer.close()
        os._exit(0)
    wait_for_child(child)
    disk.go_on()
    thread.join()
    writer.close()
    check(read(path), 1)


@pytest.mark.usefixtures("unattended")
def test_a_flush_is_due_before_a_second_is_over(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the flush before on."""
    now = 100.0
    monkeypatch.setattr(trajectory_log, "monotonic", lambda: now)
    writer = write(path, 2)
    now += 0.7
    assert not writer.is_due
    now += 0.2
    assert writer.is_due
    writer.flush_beside()
    check(read(path), 2)
    write_step(writer, 3)
    now += 0.5
    assert not writer.is_due
    writer.close()


@pytest.mark.usefixtures("unattended")
def test_a_living_log_can_be_read(path: Path) -> None:
    """What was flushed is there while the writer goes on."""
    writer = write(path, 2)
    writer.flush()
    write_step(writer, 3)
    check(read(path), 2)
    writer.close()
    check(read(path), 3)


def test_a_log_without_steps_can_be_read(path: Path) -> None:
    """Nothing but a header, or the row of the reset alone."""
    writer = TrajectoryLogWriter(path, HEADER)
    writer.flush()
    content = read(path)
    assert content.states.shape == (0, 3)
    assert content.actions is not None
    assert content.actions.shape == (0, 3)
    assert content.snapshots.shape == (0, HEADER.snapshot.size)
    write_step(writer, 0)
    writer.close()
    check(read(path), 0)


def test_rows_without_any_arrays_can_be_read(path: Path) -> None:
    """Where no simulation can be seen, rewards are recorded all the same."""
    writer = TrajectoryLogWriter(path, TrajectoryHeader(facts={}))
    for step in range(3):
        writer.add_step(step, step, False, False, ())
    writer.close()
    content = read(path)
    assert content.rewards.tolist() == [1, 2]
    assert content.states.shape == (3, 0)
    assert content.actions is None


def test_a_log_torn_anywhere_keeps_the_whole_records(path: Path) -> None:
    """Cut at every byte of its last row: the rows before are there, it is counted."""
    writer = write(path, 4, every=10)
    writer.flush()
    before = path.stat().st_size
    write_step(writer, 5, frame=False)
    writer.close()
    whole = path.read_bytes()
    assert len(whole) == before + STEP_RECORD
    for size in range(before + 1, len(whole)):
        path.write_bytes(whole[:size])
        content = read(path)
        check(content, 4, every=10)
        assert content.dropped == 1
    path.write_bytes(whole[:before])
    assert read(path).dropped == 0


@pytest.mark.parametrize("place", ["kind", "checksum", "length", "payload"])
def test_a_damaged_record_ends_the_log(path: Path, place: str) -> None:
    """What comes after damage is not trusted, and counted where it can be."""
    write(path, 6, every=10).close()
    data = bytearray(path.read_bytes())
    # The rows of steps 4, 5 and 6 are at the end.
    start = len(data) - 3 * STEP_RECORD
    data[start + {"kind": 0, "checksum": 5, "length": 9, "payload": 70}[place]] ^= 0x41
    path.write_bytes(data)
    content = read(path)
    assert content.rewards.tolist() == [1 / 3, 2 / 3, 1.0]
    assert content.dropped == (1 if place in {"kind", "length"} else 3)
    assert content.header == HEADER


def test_a_frame_beyond_the_last_step_is_left_out(path: Path) -> None:
    """The step that it shows the end of is not known."""
    writer = write(path, 3)
    writer.add_frame(4, [frame_bytes(4)])
    writer.close()
    content = read(path)
    check(content, 3)
    assert content.dropped == 1


@pytest.mark.parametrize("steps", [(1,), (0, 2), (0, 1, 1)])
def test_steps_out_of_order_end_the_log(path: Path, steps: tuple[int, ...]) -> None:
    """States and actions belong together by their places."""
    writer = TrajectoryLogWriter(path, HEADER)
    for step in steps:
        writer.add_step(step, 0.0, False, False, [step_bytes(step)])
    writer.close()
    content = read(path)
    assert (len(content.states), content.dropped) == (len(steps) - 1, 1)


@pytest.mark.usefixtures("unattended")
def test_a_full_disk_costs_nothing_that_is_written(path: Path) -> None:
    """An error that names the file; a later flush writes all, once there is room."""
    writer = write(path, 2)
    writer.flush()
    size = path.stat().st_size
    for step in range(3, 9):
        write_step(writer, step)
    with file_size_limit(size + 100):
        with pytest.raises(FileNotWritten, match=path.name):
            writer.flush()
        assert path.stat().st_size == size
        check(read(path), 2)
        with pytest.raises(FileNotWritten, match="File too large"):
            writer.close()
        assert not writer.closed
    write_step(writer, 9)
    writer.close()
    check(read(path), 9)


def test_a_directory_that_is_gone_is_one_clear_error(tmp_path: Path) -> None:
    """The error names the file, not an operating system call."""
    writer = write(tmp_path / "gone" / "a.log", 1)
    with pytest.raises(FileNotWritten, match=r"a\.log: No such file or directory"):
        writer.close()
    writer.discard()


class _Interrupt(BaseException):
    pass


@pytest.mark.usefixtures("unattended")
@pytest.mark.parametrize(
    ("call", "room"), [("pwrite", 1 << 20), ("pwrite", 50), ("ftruncate", 50)]
)
def test_an_interrupted_flush_is_taken_up_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, call: str, room: int
) -> None:
    """After Ctrl-C just behind any of its calls the next flush writes all, once."""
    writer = write(path, 2)
    writer.flush()
    write_step(writer, 3)
    real: Callable[..., int] = getattr(os, call)

    def interrupted(*arguments: object) -> int:
        monkeypatch.setattr(os, call, real)
        try:
            return real(*arguments)
        finally:
            raise _Interrupt

    monkeypatch.setattr(os, call, interrupted)
    with file_size_limit(path.stat().st_size + room), pytest.raises(_Interrupt):
        writer.flush()
    write_step(writer, 4)
    writer.close()
    check(read(path), 4)


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from test_trajectory_log import write
writer = write(Path({path!r}), 700)
writer.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_leaves_a_readable_log(path: Path) -> None:
    """What was flushed is there after SIGKILL."""
    code = KILLED.format(tests=str(Path(__file__).parent), path=str(path))
    process = subprocess.run([sys.executable, "-c", code], check=False)
    assert process.returncode == -signal.SIGKILL
    check(read(path), 700)


@pytest.mark.usefixtures("unattended")
def test_a_forked_child_writes_nothing(path: Path) -> None:
    """A child may let go of the log; writing in it is an error, and does no harm."""
    writer = write(path, 3)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            with pytest.raises(ClosedError, match="belongs to process"):
                writer.flush()
            writer.close()
            writer.discard()
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0
    assert not path.exists()
    write_step(writer, 4)
    writer.close()
    check(read(path), 4)


def test_nothing_is_left_of_a_discarded_log(path: Path) -> None:
    """Whether it was in a file already, or closed, or not; asked once or twice."""
    for end in (lambda w: None, TrajectoryLogWriter.flush, TrajectoryLogWriter.close):
        writer = write(path, 3)
        end(writer)
        writer.discard()
        writer.discard()
        assert not path.exists()


def test_a_log_that_a_discarded_reset_left_is_replaced(path: Path) -> None:
    """The older file's reader keeps what it has."""
    write(path, 9).close()
    with TrajectoryLogReader(path) as older:
        write(path, 1).close()
        check(read(path), 1)
        check(older.content(), 9)


def test_a_closed_log_takes_nothing(path: Path) -> None:
    """Closing is idempotent; everything else says that it is closed."""
    writer = write(path, 1)
    memory = Memory(writer)
    writer.close()
    writer.close()
    for use in (
        lambda: write_step(writer, 2),
        lambda: writer.add_frame(1, [frame_bytes(1)]),
        lambda: memory.add(2),
        lambda: writer.add_facts({}),
        lambda: writer.add_model_change(ModelChange(step=0, fields={})),
        writer.flush,
    ):
        with pytest.raises(ClosedError, match="is closed"):
            use()
    check(read(path), 1)


def test_rows_serve_one_writer_after_the_other(tmp_path: Path) -> None:
    """Handed on they are used again, also while the first writer has them."""
    first = write(tmp_path / "a.log", 3)
    facts = dataclasses.replace(HEADER, facts={"env_id": "other"})
    second = TrajectoryLogWriter(tmp_path / "b.log", facts, rows=first.rows)
    assert second.rows is first.rows
    write_step(second, 0)
    write_step(first, 4)
    write_step(second, 1)
    first.close()
    second.close()
    check(read(tmp_path / "a.log"), 4)
    check(read(tmp_path / "b.log"), 1)
    assert read(tmp_path / "b.log").header == facts


@pytest.mark.parametrize(
    "other",
    [
        {"state": ()},
        {"snapshot": RowLayout()},
        {"action": None},
        {"action": Array("<i4", (3,))},
        {"observation": Array("|u1", (4,))},
    ],
)
def test_rows_that_do_not_fit_are_found_out_anew(
    tmp_path: Path, other: dict[str, Any]
) -> None:
    """As after a change of the model, also where the size is the same."""
    first = write(tmp_path / "a.log", 1)
    header = dataclasses.replace(HEADER, **other)
    assert not first.rows.fits(header)
    second = TrajectoryLogWriter(tmp_path / "b.log", header, rows=first.rows)
    assert second.rows.fits(header)
    second.close()
    assert read(tmp_path / "b.log").header == header
    first.close()


@pytest.mark.parametrize("size", [1, 60_000, 3_000_000])
def test_the_memory_of_what_waits_is_bounded(path: Path, size: int) -> None:
    """Whatever the size of a row: some rows, or few megabytes of many."""
    header = TrajectoryHeader(
        facts={},
        snapshot=RowLayout.packed([("a", Array("|u1", (size,)))]),
        action=Array("|u1", (size,)),
    )
    row = bytes(size)
    tracemalloc.start()
    writer = TrajectoryLogWriter(path, header)
    for step in range(20_000 if size == 1 else 60_000_000 // size // 2):
        writer.add_step(step, 0.0, False, False, [row])
        writer.add_frame(step, [row])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < max(8 << 20, 6 * size)
    writer.discard()


def test_a_file_of_another_kind_is_refused(path: Path) -> None:
    """One clear error each, which names the file."""
    for data, reason in [
        (b"", "no trajectory"),
        (b"something else, of more than a line's length", "no trajectory"),
        (b"mjrec trajectory log 1", "cut off in its first line"),
        (b"mjrec trajectory log one       \n", "no format version"),
        (b"mjrec trajectory log 0         \n", "no format version 0"),
        (b"mjrec trajectory log 1         \n", "end of its header"),
    ]:
        path.write_bytes(data)
        with pytest.raises(UnreadableFile, match=reason) as error:
            read(path)
        assert error.value.path == path


def test_a_newer_format_is_refused_with_the_way_out(path: Path) -> None:
    """Nothing of it is guessed at."""
    path.write_bytes(b"mjrec trajectory log 12        \nwhatever comes then")
    with pytest.raises(
        UnreadableFile, match=r"newer mjrec, in format version 12.* to 1: update mjrec"
    ):
        read(path)


def test_a_log_cut_within_its_header_is_refused(path: Path) -> None:
    """Without it nothing is known of the rows."""
    write(path, 1).close()
    data = path.read_bytes()
    path.write_bytes(data[:200])
    with pytest.raises(UnreadableFile, match="cut off before the end of its header"):
        read(path)
    path.write_bytes(data[:100] + b"x" + data[101:])
    with pytest.raises(UnreadableFile, match="its header is damaged"):
        read(path)


def record(kind: bytes, payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    checksum = struct.pack("<I", zlib.crc32(payload, zlib.crc32(kind + length)))
    padding = bytes(-len(payload) % 8)
    return kind + checksum + length + payload + padding


def forge(path: Path, header: str, *records: bytes) -> None:
    line = b"mjrec trajectory log 1".ljust(31) + b"\n"
    path.write_bytes(line + record(b"head", header.encode()) + b"".join(records))


ROWS = '"state": [], "snapshot": [], "action": null, "observation": null'
ACTION = '"state": [], "snapshot": [], "observation": null, "action": '


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("[]", "an object belongs there, not a list"),
        ("{}", "it has no 'facts'"),
        ("{" * 100_000, "JSON"),
        ('{"facts": 1, "rows": {}}', "'facts' is wrong"),
        ('{"facts": {}, "rows": {"state": 3}}', "'state' is wrong"),
        ('{"facts": {}, "rows": {"state": [["a", 0]]}}', "name, offset and length"),
        ('{"facts": {}, "rows": {"state": [["a", 1, 1]]}}', "begin at 1, not at 0"),
        ('{"facts": {}, "rows": {"state": [["a", 0, -1]]}}', "cannot be a number"),
        ('{"facts": {}, "rows": {"state": [["a/b", 0, 1]]}}', "cannot name an array"),
        (
            '{"facts": {}, "rows": {"state": [["a", 0, 1], ["a", 1, 1]]}}',
            "the same name",
        ),
        (
            f'{{"facts": {{}}, "rows": {{{ACTION}{{"dtype": "|O", "shape": []}}}}}}',
            "'|O' is no dtype",
        ),
        (
            f'{{"facts": {{}}, "rows": {{{ACTION}{{"dtype": "<f8", "shape": '
            "[4294967296, 4294967296, 1]}}}",
            "cannot be a number",
        ),
        (
            f'{{"facts": {{}}, "rows": {{{ACTION}{{"dtype": "<f8", "shape": '
            "[200000000, 200000000]}}}",
            "too large",
        ),
    ],
)
def test_a_hostile_header_is_refused(path: Path, header: str, reason: str) -> None:
    """Each is one clear error, before any memory is taken."""
    forge(path, header)
    tracemalloc.start()
    with pytest.raises(UnreadableFile, match=reason.replace("|", r"\|")):
        read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        struct.pack("<qQ", 0, 1 << 40),
        struct.pack("<qQ", 0, 3) + b"[{]",
        struct.pack("<qQ", 0, 2) + b"[]x",
        struct.pack("<qQ", 0, 44)
        + b'[{"name": "a", "dtype": "|O", "shape": [1]}]'
        + bytes(8),
        struct.pack("<qQ", 0, 51)
        + b'[{"name": "a", "dtype": "<f8", "shape": [10000000]}]'[:51],
    ],
)
def test_a_hostile_model_change_is_refused(path: Path, payload: bytes) -> None:
    """Its table is believed only where it fits what is there."""
    forge(path, f'{{"facts": {{}}, "rows": {{{ROWS}}}}}', record(b"chng", payload))
    with pytest.raises(UnreadableFile, match=r"change of the model|dtype"):
        read(path)


def test_a_length_beyond_the_file_is_not_believed(path: Path) -> None:
    """No memory is taken for what is not there."""
    forge(
        path,
        f'{{"facts": {{}}, "rows": {{{ROWS}}}}}',
        b"step" + struct.pack("<IQ", 0, 1 << 62),
    )
    assert read(path).dropped == 1


def test_random_damage_is_an_error_or_a_shorter_log(path: Path) -> None:
    """Whatever happens to the bytes: what is read was written, the rest is counted."""
    write(path, 9).close()
    data = path.read_bytes()
    rows = read(path).snapshots.tobytes()
    chance = random.Random(1)
    for _ in range(300):
        damaged = bytearray(data[: chance.randrange(len(data))] or data)
        for _ in range(chance.randrange(4)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        path.write_bytes(damaged)
        try:
            content = read(path)
        except UnreadableFile:
            continue
        assert rows.startswith(content.snapshots.tobytes())


def test_a_log_in_place_of_which_there_is_something_else(tmp_path: Path) -> None:
    """A missing file, a directory and a pipe are errors, none of them a wait."""
    os.mkfifo(tmp_path / "pipe.log")
    for name, reason in [
        ("missing.log", "No such file"),
        ("", "not a regular file"),
        ("pipe.log", "not a regular file"),
    ]:
        with pytest.raises(UnreadableFile, match=reason):
            read(tmp_path / name)


def test_a_closed_reader_says_so(path: Path) -> None:
    """What is in memory stays."""
    write(path, 3).close()
    reader = TrajectoryLogReader(path)
    reader.close()
    reader.close()
    with pytest.raises(ClosedError, match="is closed"):
        reader.snapshots(0, 1)
    assert reader.frame_count == 4


def test_a_log_that_shrinks_while_it_is_read_is_an_error(path: Path) -> None:
    """Never rows of something else."""
    write(path, 3).close()
    with TrajectoryLogReader(path) as reader:
        os.truncate(path, 1000)
        with pytest.raises(UnreadableFile, match="shorter while it was read"):
            reader.snapshots(0, 4)
        path.write_bytes(bytes(100_000))
        with pytest.raises(UnreadableFile, match="changed while it was read"):
            reader.snapshots(0, 4)

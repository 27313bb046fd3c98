# SPDX-License-Identifier: Apache-2.0
"""The log keeps what was written to it, whatever becomes of the process or the disk."""

from __future__ import annotations

import gc
import os
import random
import signal
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit

import mjrec.formats.trajectory_log as trajectory_log
from mjrec.errors import ClosedError, FileNotWritten, InvalidArgument, UnreadableFile
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
STEP_RECORD = 16 + 24 + ROW_SIZE
NAN = struct.pack("<Q", 0x7FF8000000BADBAD)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.trajectory.0.1.episode000027.log"


def step_bytes(step: int) -> bytes:
    return NAN + bytes((step * 7 + i) % 256 for i in range(ROW_SIZE - 8))


def frame_bytes(step: int) -> bytes:
    size = HEADER.snapshot.size - 1
    return NAN + bytes((step * 11 + i) % 256 for i in range(size - 8)) + b"\x01"


def put(row: np.ndarray, data: bytes) -> None:
    row[:] = np.frombuffer(data, np.uint8)


def write_step(writer: TrajectoryLogWriter, step: int, *, frame: bool = True) -> None:
    put(writer.step_row(step, step / 3, step == 8, step == 9), step_bytes(step))
    if frame:
        put(writer.frame_row(step), frame_bytes(step))


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


def test_rows_beyond_one_block_come_back(path: Path) -> None:
    """Blocks that filled up and were written in between are one sequence again."""
    write(path, 2000, every=2).close()
    check(read(path), 2000, every=2)


def test_ranges_across_blocks_can_be_read(path: Path) -> None:
    """A reader gives any range, from whichever blocks it comes."""
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


def test_what_depends_on_something_else_comes_after_it(path: Path) -> None:
    """Torn anywhere, no frame lacks its model or step, and the end lacks no row."""
    writer = TrajectoryLogWriter(path, HEADER)
    writer.add_facts({"complete": True})
    put(writer.frame_row(0), frame_bytes(0))
    put(writer.step_row(0, 0, False, False), step_bytes(0))
    writer.add_model_change(ModelChange(step=0, fields={}))
    writer.close()
    data = path.read_bytes()
    kinds, offset = [], 32
    while offset < len(data):
        kind, _, length = struct.unpack_from("<4sIQ", data, offset)
        kinds.append(kind)
        offset += 16 + -(-length // 8) * 8
    assert kinds == [b"head", b"chng", b"step", b"fram", b"fact"]


def test_a_large_model_change_is_not_kept_in_memory(path: Path) -> None:
    """A texture goes to the disk at once."""
    writer = write(path, 1)
    texture = np.zeros(3 << 20, np.uint8)
    writer.add_model_change(ModelChange(step=1, fields={"tex_data": texture}))
    (change,) = read(path).model_changes
    assert change.fields["tex_data"].shape == texture.shape
    writer.close()


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


def test_rows_are_where_a_simulation_can_write_them(path: Path) -> None:
    """MuJoCo writes float64: rows begin at multiples of 8 bytes."""
    writer = TrajectoryLogWriter(path, HEADER)
    for step in range(3):
        assert writer.step_row(step, 0, False, False).ctypes.data % 8 == 0
        assert writer.frame_row(step).ctypes.data % 8 == 0
    writer.discard()


def test_a_withdrawn_row_was_never_there(path: Path) -> None:
    """A row that could not be filled is taken back, once, and given out again."""
    writer = write(path, 3)
    writer.frame_row(3)
    writer.withdraw_row()
    writer.withdraw_row()
    writer.step_row(4, 5.0, True, True)
    writer.withdraw_row()
    write_step(writer, 4)
    writer.close()
    writer.withdraw_row()
    check(read(path), 4)


def add_moment(writer: TrajectoryLogWriter, step: int) -> None:
    row, snapshot = step_bytes(step), frame_bytes(step)
    writer.add_moment(step, step / 3, step == 8, step == 9, row, snapshot)


def test_a_moment_is_a_step_with_its_frame(tmp_path: Path) -> None:
    """The file is the same, byte for byte, also where blocks are full."""
    path = tmp_path / "moments.log"
    writer = TrajectoryLogWriter(path, HEADER)
    steps = 2 * min(writer.blocks.steps.capacity, writer.blocks.frames.capacity) + 3
    write_step(writer, 0)
    for step in range(1, steps + 1):
        add_moment(writer, step)
    # There is nothing to take back.
    writer.withdraw_row()
    writer.close()
    check(read(path), steps)


def test_a_moment_that_finds_no_room_was_not_added(path: Path) -> None:
    """Neither its step nor its frame; both can be added again."""
    writer = write(path, 0)
    rows = min(writer.blocks.steps.capacity, writer.blocks.frames.capacity)
    for step in range(1, rows):
        add_moment(writer, step)
    with file_size_limit(5000), pytest.raises(FileNotWritten):
        add_moment(writer, rows)
    add_moment(writer, rows)
    writer.close()
    check(read(path), rows)


def wait_until(condition: Callable[[], object]) -> None:
    # Far longer than it takes, because the machine may have other work.
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_rows_are_there_within_a_second_though_none_follows(path: Path) -> None:
    """A simulation that hangs after its third step loses nothing by that."""
    writer = write(path, 3)
    writer.seal_row()
    wait_until(path.exists)
    check(read(path), 3)
    write_step(writer, 4)
    writer.seal_row()
    wait_until(lambda: read(path).states.shape[0] == 5)
    writer.close()
    check(read(path), 4)


def test_a_row_that_is_being_filled_is_not_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever fills it says when it is whole."""
    writer = write(path, 3)
    writer.step_row(4, 0, False, False)
    now = time.monotonic()
    monkeypatch.setattr(trajectory_log, "monotonic", lambda: now + 10)
    writer.flush_if_due()
    assert not path.exists()
    writer.withdraw_row()
    writer.flush_if_due()
    check(read(path), 3)
    writer.close()


def test_looking_after_writers_ends_with_the_last_of_them(path: Path) -> None:
    """No thread stays; one that was dropped without a close is none of them."""
    writer = write(path, 1)
    names = lambda: [t.name for t in threading.enumerate()]  # noqa: E731
    assert "mjrec-flushing" in names()
    del writer
    gc.collect()
    wait_until(lambda: "mjrec-flushing" not in names())


def test_a_forked_child_can_close_what_is_being_flushed(path: Path) -> None:
    """Another thread held the lock when it was forked, and is not there."""
    writer = write(path, 1)
    with writer._lock:
        child = os.fork()
        if child == 0:
            threading.Thread(target=writer.close).start()
            writer.close()
            os._exit(0)
    end = time.monotonic() + 20
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        assert time.monotonic() < end
        time.sleep(0.01)
    writer.close()
    check(read(path), 1)


def test_a_flush_is_due_before_a_second_is_over(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is written before; the next row after it brings the rest."""
    now = 100.0
    monkeypatch.setattr(trajectory_log, "monotonic", lambda: now)
    writer = write(path, 2)
    now += 0.7
    write_step(writer, 3)
    assert not path.exists()
    now += 0.2
    write_step(writer, 4)
    check(read(path), 3)
    now += 0.5
    write_step(writer, 5)
    check(read(path), 3)
    writer.close()


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
        assert writer.step_row(step, step, False, False).size == 0
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
    # The rows of 7 steps and that of one frame are at the end.
    frame_record = 16 + 8 + HEADER.snapshot.size
    start = len(data) - -(-frame_record // 8) * 8 - 3 * STEP_RECORD
    data[start + {"kind": 0, "checksum": 5, "length": 9, "payload": 70}[place]] ^= 0x41
    path.write_bytes(data)
    content = read(path)
    assert content.rewards.tolist() == [1 / 3, 2 / 3, 1.0]
    assert content.dropped == (1 if place in {"kind", "length"} else 4)
    assert content.header == HEADER


def test_a_frame_beyond_the_last_step_is_left_out(path: Path) -> None:
    """The step that it shows the end of is not known."""
    writer = write(path, 3)
    put(writer.frame_row(4), frame_bytes(4))
    writer.close()
    content = read(path)
    check(content, 3)
    assert content.dropped == 1


@pytest.mark.parametrize("steps", [(1,), (0, 2), (0, 1, 1)])
def test_steps_out_of_order_end_the_log(path: Path, steps: tuple[int, ...]) -> None:
    """States and actions belong together by their places."""
    writer = TrajectoryLogWriter(path, HEADER)
    for step in steps:
        put(writer.step_row(step, 0, False, False), step_bytes(step))
    writer.close()
    content = read(path)
    assert (len(content.states), content.dropped) == (len(steps) - 1, 1)


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


def test_a_full_disk_is_noticed_where_a_block_is_full(path: Path) -> None:
    """The row that found no room was not added, and can be asked for again."""
    writer = TrajectoryLogWriter(path, HEADER)
    rows = writer.blocks.steps.capacity
    for step in range(rows):
        write_step(writer, step)
    with file_size_limit(5000), pytest.raises(FileNotWritten):
        writer.step_row(rows, 0, False, False)
    write_step(writer, rows)
    writer.close()
    check(read(path), rows)


def test_a_directory_that_is_gone_is_one_clear_error(tmp_path: Path) -> None:
    """The error names the file, not an operating system call."""
    writer = write(tmp_path / "gone" / "a.log", 1)
    with pytest.raises(FileNotWritten, match=r"a\.log: No such file or directory"):
        writer.close()
    writer.discard()


class _Interrupt(BaseException):
    pass


@pytest.mark.parametrize("call", ["pwritev", "pwrite", "ftruncate"])
def test_an_interrupted_flush_is_taken_up_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, call: str
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
    # The second and the third are called where the disk is full.
    room = 50 if call != "pwritev" else 1 << 20
    with file_size_limit(path.stat().st_size + room), pytest.raises(_Interrupt):
        writer.flush()
    write_step(writer, 4)
    writer.close()
    check(read(path), 4)


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from test_trajectory_log import write, write_step
writer = write(Path({path!r}), 700)
writer.flush()
write_step(writer, 701)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_leaves_a_readable_log(path: Path) -> None:
    """What was flushed is there after SIGKILL."""
    code = KILLED.format(tests=str(Path(__file__).parent), path=str(path))
    process = subprocess.run([sys.executable, "-c", code], check=False)
    assert process.returncode == -signal.SIGKILL
    check(read(path), 700)


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
    writer.close()
    writer.close()
    for use in (
        lambda: writer.step_row(2, 0, False, False),
        lambda: writer.frame_row(2),
        lambda: add_moment(writer, 2),
        lambda: writer.add_facts({}),
        lambda: writer.add_model_change(ModelChange(step=0, fields={})),
        writer.flush,
    ):
        with pytest.raises(ClosedError, match="is closed"):
            use()
    check(read(path), 1)


def test_blocks_serve_one_writer_after_the_other(tmp_path: Path) -> None:
    """Handed on they are used again where they fit and are free, else replaced."""
    first = write(tmp_path / "a.log", 3)
    second = TrajectoryLogWriter(tmp_path / "b.log", HEADER, blocks=first.blocks)
    assert second.blocks is not first.blocks
    for writer in (first, second):
        writer.close()
    again = TrajectoryLogWriter(tmp_path / "c.log", HEADER, blocks=first.blocks)
    assert again.blocks is first.blocks
    for step in range(3):
        write_step(again, step)
    again.close()
    check(read(tmp_path / "c.log"), 2)
    check(read(tmp_path / "a.log"), 3)
    other = TrajectoryHeader(facts={}, snapshot=HEADER.snapshot)
    assert (
        TrajectoryLogWriter(tmp_path / "d.log", other, blocks=first.blocks).blocks
        is not first.blocks
    )


@pytest.mark.parametrize("size", [1, 60_000, 3_000_000])
def test_the_memory_of_blocks_is_bounded(path: Path, size: int) -> None:
    """Whatever the size of a row: two blocks stay below 4 MB, or are single rows."""
    header = TrajectoryHeader(
        facts={},
        snapshot=RowLayout.packed([("a", Array("|u1", (size,)))]),
        action=Array("|u1", (size,)),
    )
    tracemalloc.start()
    writer = TrajectoryLogWriter(path, header)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < max(4 << 20, 2 * size + 50_000)
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

# SPDX-License-Identifier: Apache-2.0
"""Recordings in a monitor's row logs are there whatever becomes of the process."""

from __future__ import annotations

import itertools
import os
import signal
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from full_disk import file_size_limit
from processes import forked, kill_self
from random_rows import ACTION, DTYPE, FACTS, INFIX, NAME, STATE, check, write
from recordings import add_facts, drop
from trajectories_by_hand import add_row, new_logs
from trajectory_contents import TrajectoryContent, content_of

from mjrec.errors import FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats import row_log, span_writer, spans
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import (
    journal_name,
    lock_name,
    trajectory_prefix,
)
from mjrec.formats.row_log import TAIL_HEAD, RowLog, tail_path
from mjrec.formats.span_writer import SpanLogs
from mjrec.formats.spans import (
    is_in_flight,
    log_paths,
    recordings_in,
    recordings_in_flight,
    remove_if_done,
)
from mjrec.formats.trajectory import ModelChange, packed, row_dtype
from mjrec.formats.trajectory_log import open_recording

ROW, CAPACITY = DTYPE.itemsize, 8


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file that the recording will be."""
    return tmp_path / f"{NAME}.h5"


@pytest.fixture
def logs(tmp_path: Path) -> SpanLogs:
    """Logs whose tails hold eight rows."""
    return new_logs(tmp_path, INFIX, tail_bytes=CAPACITY * ROW)


def read(path: Path) -> TrajectoryContent:
    with open_recording(path) as reader:
        return content_of(reader)


def episode(directory: Path, number: int) -> Path:
    return directory / f"{trajectory_prefix(INFIX, number)}.h5"


def files_of(directory: Path) -> tuple[Path, Path, Path, Path]:
    """Return the journal, and the only log there is, its tail and its changes."""
    [log] = log_paths(directory)
    journal = directory / journal_name(INFIX)
    return journal, log, tail_path(log), log.with_suffix(".looks")


def change(step: int, **fields: Any) -> ModelChange:
    return ModelChange(step=step, fields=fields or {"a": np.ones(2)})


@pytest.fixture(params=["a mapped tail", "no tail"])
def mapped(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the file system has mappings that outlive a process."""
    is_mapped = bool(request.param == "a mapped tail")
    monkeypatch.setattr(row_log, "_may_be_mapped", lambda _: is_mapped)
    return is_mapped


# --- what was written comes back -----------------------------------------------------


def test_rows_are_there_when_they_are_counted_and_when_all_is_closed(
    logs: SpanLogs, path: Path, mapped: bool
) -> None:
    """Wherever the tail wraps, also for an open reader; then there is the log alone."""
    span = write(logs, 2)
    found, log, tail, _ = files_of(path.parent)
    assert tail.exists() == mapped
    with open_recording(path) as reader:
        for step in range(3, 3 * CAPACITY + 5):
            write(logs, step, first=step, span=span)
            check(read(path), step)
            check(content_of(reader), 2)
        logs.close()
        logs.close()
        check(content_of(reader), 2)
    check(read(path), step)
    assert log.stat().st_size == (step + 1) * ROW
    assert sorted(path.parent.iterdir()) == sorted([found, log])


def test_recordings_of_one_log_come_back_bit_for_bit(
    logs: SpanLogs, tmp_path: Path
) -> None:
    """Each has its own rows and facts, ended or not; the last is written still."""
    lengths = [3, 0, 17, 40, 2]
    said = [{**FACTS, "number": 0}, {"number": 1}, {}, {**FACTS, "seed": 8}, FACTS]
    for number, steps in enumerate(lengths):
        span = write(logs, steps, episode=number, every=2, facts=said[number])
        if number % 2:
            span.end({"complete": True})
    for _ in range(2):
        found = recordings_in_flight(tmp_path)
        assert [each.path for each in found] == [episode(tmp_path, k) for k in range(5)]
        for number, steps in enumerate(lengths):
            content = read(found[number].path)
            check(content, steps, every=2)
            ending = {"complete": True} if number % 2 else {}
            assert (content.facts, content.dropped) == ({**said[number], **ending}, 0)
        assert len(list(log_paths(tmp_path))) == 1
        logs.close()


def test_model_changes_come_back(logs: SpanLogs, path: Path) -> None:
    """Names, kinds and values; of a row that was never counted there is none."""
    fields = {
        "geom_rgba": np.arange(8, dtype=np.float32).reshape(2, 4),
        "stat.extent": np.float64(2.5),
        "mat_texid": np.array([[1, 2]], ">i4"),
        "eq_active": np.array([True]),
        "hfield_data": np.empty((0, 3), np.float32),
    }
    span = logs.begin(path.stem, FACTS, DTYPE)
    span.log.add_change(change(0, **fields))
    add_row(span, 0)
    span.log.add_change(change(1))
    assert [each.step for each in read(path).model_changes] == [0]
    add_row(span, 1)
    other = logs.begin(trajectory_prefix(INFIX, 28), FACTS, DTYPE)
    other.log.add_change(change(0, b=np.ones(1)))
    add_row(other, 0)
    first, second = read(path).model_changes
    assert (first.step, second.step, list(second.fields)) == (0, 1, ["a"])
    for name, values in fields.items():
        little = np.asarray(values).astype(values.dtype.newbyteorder("<"))
        np.testing.assert_array_equal(first.fields[name], little, strict=True)
    [last] = read(episode(path.parent, 28)).model_changes
    assert list(last.fields) == ["b"]


@pytest.mark.parametrize(
    ("name", "values"), [("a", np.array(["text"])), ("a/b", np.zeros(1))]
)
def test_what_no_file_can_hold_is_refused(
    logs: SpanLogs, path: Path, name: str, values: Any
) -> None:
    """As a change to the model, after which the log goes on, and as a row."""
    span = write(logs, 3)
    with pytest.raises(InvalidArgument, match="cannot be recorded"):
        span.log.add_change(ModelChange(step=0, fields={name: values}))
    write(logs, 4, first=4, span=span)
    check(read(path), 4)
    with pytest.raises(ValueError, match=r"not a valid (dtype|array name)"):
        row_dtype(snapshot=packed([(name, (values.dtype, (1,)))]))


def test_a_reader_beside_a_writer_sees_whole_recordings(tmp_path: Path) -> None:
    """With all changes to the model, though the tail wraps with every fourth row."""
    path, enough = episode(tmp_path, 0), tmp_path / "enough"

    def record() -> None:
        logs = new_logs(tmp_path, INFIX, tail_bytes=1)
        span = logs.begin(path.stem, {}, row_dtype(state=STATE))
        step = 0
        while step % 100 or step < 1000 or not enough.exists():
            if step % 100 == 0:
                span.log.add_change(change(step))
            add_row(span, step, state=step, reward=step)
            step += 1
        span.end({"complete": True, "rows": step})
        logs.close()

    process = os.fork()
    if process == 0:
        try:
            record()
            os._exit(0)
        finally:
            os._exit(1)
    try:
        seen, is_over = set(), False
        while not is_over:
            if not is_in_flight(path):
                continue
            with open_recording(path) as reader:
                is_over, count = "complete" in reader.facts, reader.row_count
                assert reader.dropped == 0
                assert reader.rewards.tolist() == list(range(1, count))
                assert (reader.states(0, count) == np.arange(count)[:, None]).all()
                changes = [each.step for each in reader.iter_model_changes()]
                assert changes == list(range(0, count, 100))
                assert not is_over or count == reader.facts["rows"]
            seen.add(count)
            if len(seen) > 5:
                enough.touch()
    finally:
        enough.touch()
    assert os.waitpid(process, 0)[1] == 0


# --- a process that is killed, a machine that crashes --------------------------------


def killed_in_the_middle_of_a_write(rows: RowLog) -> None:
    """With some rows of a full tail in the log, and half of one."""
    if rows.count == 3 * CAPACITY:
        kill_after_writing(lambda data: data[: len(data) // 2 - 3])


def killed_after_a_write(rows: RowLog) -> None:
    """With a full tail in the log, which nobody has taken note of."""
    if rows.count == 3 * CAPACITY:
        kill_after_writing(lambda data: data)


def kill_after_writing(part: Callable[[memoryview], memoryview]) -> None:
    real = os.pwrite

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        real(descriptor, part(data), offset)
        kill_self()
        return 0

    os.pwrite = pwrite


def killed_in_the_next_slot(rows: RowLog) -> None:
    """When the first slot of a tail that was written is filled again."""
    if rows.count == 3 * CAPACITY:
        rows.make_room()
        rows.slots[0] = 5
        kill_self()


def killed_in_a_close(rows: RowLog) -> None:
    """With all rows in the log, before the tail is removed."""
    if rows.count == 3 * CAPACITY + 2:
        Path.unlink = kill_self  # type: ignore[method-assign]
        rows.close()


MOMENTS = [
    *(killed_in_the_middle_of_a_write, killed_after_a_write),
    *(killed_in_the_next_slot, killed_in_a_close),
]


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_process_loses_no_counted_row(
    logs: SpanLogs, path: Path, mapped: bool, moment: Callable[[RowLog], None]
) -> None:
    """At any moment; nothing was flushed, and no signal's handler was called."""

    def record(tell: Callable[[], object]) -> None:
        span = write(logs, 0)
        for step in itertools.count(1):
            moment(span.log)
            write(logs, step, first=step, span=span)
            tell()

    steps, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert steps >= 3 * CAPACITY - 1
    # Without a tail a row counts as soon as it is in the log.
    check(read(path), steps + (not mapped and moment is killed_after_a_write))


class Interrupt(BaseException):
    """As Ctrl-C raises it."""


@pytest.mark.parametrize("written", [0, 5, 8 * ROW])
def test_an_interrupted_write_is_taken_up_again(
    logs: SpanLogs, path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """After Ctrl-C at any byte of it; each row is there once."""
    last = 2 * CAPACITY - 1
    span = write(logs, last)
    real = os.pwrite

    def pwrite(descriptor: int, data: memoryview, offset: int) -> int:
        monkeypatch.undo()
        real(descriptor, data[:written], offset)
        raise Interrupt

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(Interrupt):
        write(logs, last + 1, first=last + 1, span=span)
    check(read(path), last)
    write(logs, last + CAPACITY, first=last + 1, span=span)
    logs.close()
    check(read(path), last + CAPACITY)


HEADS = {
    "short": (9, ROW // 8),
    "other rows": (9, ROW // 8 + 1, CAPACITY),
    "beyond its end": (9, ROW // 8, CAPACITY + 1),
    "no rows": (9, ROW // 8, 0),
}


@pytest.mark.parametrize("head", HEADS)
def test_a_tail_of_something_else_is_passed_over(
    logs: SpanLogs, path: Path, head: str
) -> None:
    """What it says would lead beyond it, or to rows of another size."""
    write(logs, 4)
    _, _, tail, _ = files_of(path.parent)
    logs.close()
    words = struct.pack(f"={len(HEADS[head])}Q", *HEADS[head])
    size = len(words) if head == "short" else TAIL_HEAD + CAPACITY * ROW
    tail.write_bytes(words.ljust(size, b"\0"))
    content = read(path)
    check(content, 4)
    assert content.dropped == 0


def kill_in_line(number: int, part: Callable[[bytes], bytes]) -> None:
    """Have this process die in the writing of a line of the journal."""
    real, lines = os.write, itertools.count(1)

    def write_part(descriptor: int, data: bytes) -> int:
        if next(lines) < number:
            return real(descriptor, data)
        real(descriptor, part(data))
        kill_self()
        return 0

    os.write = write_part


PARTS: dict[str, Callable[[bytes], bytes]] = {
    "before": lambda line: b"",
    "in the middle": lambda line: line[: len(line) // 2],
    "before the last byte": lambda line: line[:-1],
    "behind": lambda line: line,
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("line", range(1, 6))
def test_a_process_killed_in_a_line_of_the_journal_loses_nothing_else(
    logs: SpanLogs, tmp_path: Path, line: int, part: str
) -> None:
    """What was recorded before is there; what was being said is said or is not."""
    lines = ["rows", "begin 0", "end 0", "begin 1", "end 1"]

    def record(tell: Callable[[], object]) -> None:
        kill_in_line(line, PARTS[part])
        for number in range(2):
            span = write(logs, 5, episode=number)
            tell()
            span.end({"complete": True})

    recorded, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert recorded == (line - 1) // 2
    found = {each.name: each.path for each in recordings_in_flight(tmp_path)}
    said = lines[: line - (part != "behind")]
    for number in range(2):
        name = trajectory_prefix(INFIX, number)
        assert (name in found) == (f"begin {number}" in said)
        if number < recorded:
            content = read(found[name])
            check(content, 5)
            assert ("complete" in content.facts) == (f"end {number}" in said)
    # Somebody puts things in order.
    for each in found.values():
        add_facts(each, {"later": 1})
        assert read(each).facts["later"] == 1
    for number in range(2):
        # Also one whose line lacked its end only, which it has by now.
        drop(episode(tmp_path, number))
    for left in log_paths(tmp_path):
        remove_if_done(left)
    assert [path.suffix for path in tmp_path.iterdir()] == [".jsonl"]


def test_lost_rows_of_an_ended_recording_are_counted(
    logs: SpanLogs, path: Path
) -> None:
    """Cut at every word; the journal says how many rows there were."""
    write(logs, 5).end({"complete": True})
    write(logs, 5, episode=28).end({"complete": True})
    logs.close()
    _, log, *_ = files_of(path.parent)
    for size in range(4 * ROW - 8, 3 * ROW - 1, -8):
        os.truncate(log, size)
        check(read(path), 2)
    assert read(path).dropped == 3
    content = read(episode(path.parent, 28))
    assert (len(content.states), content.dropped) == (0, 6)


@pytest.mark.parametrize("stale", ["zeros", "an older tail", "zeros behind the head"])
def test_a_stale_tail_ends_a_recording(logs: SpanLogs, path: Path, stale: str) -> None:
    """Its pages are older than the log, or never were written: no row is invented."""
    span = write(logs, 12)
    _, _, tail, _ = files_of(path.parent)
    older = tail.read_bytes()
    write(logs, 18, first=13, span=span)
    newer = tail.read_bytes()
    logs.release()
    # The log has rows 0 to 15, the tail of 8 rows those from 16 on.
    contents = {"zeros": bytes(len(newer)), "an older tail": older}
    behind = newer[:4096] + bytes(len(newer) - 4096)
    tail.write_bytes(contents.get(stale, behind))
    content = read(path)
    check(content, 15)
    assert content.dropped == (3 if stale == "zeros behind the head" else 0)


def test_a_log_that_changes_while_it_is_read_is_an_error(
    logs: SpanLogs, path: Path
) -> None:
    """Never rows of something else."""
    write(logs, 30)
    logs.close()
    _, log, *_ = files_of(path.parent)
    with open_recording(path) as reader:
        os.truncate(log, 5 * ROW)
        with pytest.raises(UnreadableFile, match=r"\.log: its "):
            reader.states(0, 31)
        log.write_bytes(bytes(100 * ROW))
        with pytest.raises(UnreadableFile, match="changed while it was read"):
            reader.snapshots(0, 4)


# --- a full disk ---------------------------------------------------------------------


def test_a_full_disk_when_a_log_is_made_leaves_nothing(
    logs: SpanLogs, path: Path
) -> None:
    """Its tail finds no room, or the journal; with room again it is begun."""
    for room in (0, 100, 4096):
        with file_size_limit(room), pytest.raises(FileNotWritten, match=r"openaigym\."):
            logs.begin(path.stem, FACTS, DTYPE)
        assert list(log_paths(path.parent)) == []
    write(logs, 3)
    check(read(path), 3)


@pytest.mark.parametrize("room", [0, 30])
def test_what_a_full_disk_did_not_let_be_said_is_said_later(
    logs: SpanLogs, path: Path, room: int
) -> None:
    """The journal stays as it was; an end may stand behind the next beginning."""
    span = write(logs, 3)
    found, *_ = files_of(path.parent)
    before = found.read_bytes()
    with file_size_limit(len(before) + room):
        for fail in (
            lambda: add_facts(path, {"candidate": False, "text": "x" * 100}),
            lambda: span.note({"noted": 1, "text": "x" * 100}),
            lambda: span.end({"complete": True}),
            lambda: logs.begin("x", FACTS, DTYPE),
        ):
            with pytest.raises(FileNotWritten, match=rf"{found.name}: "):
                fail()
        assert found.read_bytes() == before
        check(read(path), 3)
    write(logs, 5, episode=28)
    content = read(path)
    check(content, 3)
    assert (content.facts["noted"], content.facts["complete"]) == (1, True)
    assert "candidate" not in content.facts
    check(read(episode(path.parent, 28)), 5)


def test_a_full_disk_costs_no_step_that_was_recorded(
    logs: SpanLogs, path: Path, mapped: bool
) -> None:
    """The step that finds no room is refused, or kept in memory where none is mapped.

    With room again all goes on.
    """
    span = write(logs, 3)
    with file_size_limit(6000):
        with pytest.raises(FileNotWritten, match=r"\.log: File too large"):
            write(logs, 1000, first=4, span=span)
        recorded = span.steps
        assert 3 < recorded < 100
        check(read(path), recorded - (not mapped))
        with pytest.raises(FileNotWritten, match=r"\.log: File too large"):
            logs.close()
    write(logs, recorded + 8, first=recorded + 1, span=span)
    logs.close()
    _, _, tail, _ = files_of(path.parent)
    assert not tail.exists()
    check(read(path), recorded + 8)


def test_a_change_on_a_full_disk_can_be_added_again(logs: SpanLogs, path: Path) -> None:
    """The error names the file; what was added before stays, and nothing of this."""
    span = write(logs, 1)
    span.log.add_change(change(2))
    write(logs, 2, first=2, span=span)
    *_, looks = files_of(path.parent)
    texture = change(3, tex_data=np.zeros(3 << 20, np.uint8))
    with (
        file_size_limit(looks.stat().st_size + 40),
        pytest.raises(FileNotWritten, match=rf"{looks.name}: "),
    ):
        span.log.add_change(texture)
    span.log.add_change(texture)
    write(logs, 3, first=3, span=span)
    content = read(path)
    check(content, 3)
    assert [list(c.fields) for c in content.model_changes] == [["a"], ["tex_data"]]


# --- logs and what is in them --------------------------------------------------------


def test_a_log_ends_where_the_next_rows_do_not_belong(
    logs: SpanLogs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of another kind, to be deleted alone, or behind many; changes count as rows."""
    other = row_dtype(state=STATE, action=np.dtype(("<i4", ACTION.shape)))
    monkeypatch.setattr(span_writer, "_LONG", 10 * ROW)
    write(logs, 5, episode=0)
    write(logs, 5, episode=1)
    texture = change(1, t=np.zeros(2 * ROW))
    write(logs, 0, episode=2).log.add_change(texture)
    write(logs, 0, episode=3)
    write(logs, 0, episode=4, dtype=other)
    for number in (5, 6, 7):
        name = trajectory_prefix(INFIX, number)
        add_row(logs.begin(name, FACTS, other, alone=number < 7), 0)
    found = [recordings_in(log) for log in log_paths(tmp_path)]
    numbers = [[int(recording.name[-6:]) for recording in each] for each in found]
    assert numbers == [[0, 1], [2], [3], [4], [5], [6], [7]]
    tails = [tail_path(log).exists() for log in log_paths(tmp_path)]
    assert tails == [False] * 6 + [True]
    check(read(episode(tmp_path, 1)), 5)
    check(read(episode(tmp_path, 4)), 0, dtype=other)


def test_a_log_of_which_nothing_is_needed_is_removed(
    logs: SpanLogs, tmp_path: Path
) -> None:
    """With its files, when the last of its recordings is dropped, a file, a video."""
    write(logs, 3, episode=0).log.add_change(change(4))
    video = {"kept": False, "video": {"name": "v.mp4"}}
    paths = [episode(tmp_path, number) for number in range(4)]
    for number in (1, 2, 3):
        write(logs, 3, episode=number, facts=video if number == 3 else FACTS)
    logs.close()
    log = files_of(tmp_path)[1]
    paths[0].write_bytes(b"a file")
    drop(paths[1])
    (tmp_path / "v.mp4").touch()
    assert is_in_flight(paths[3])
    (tmp_path / "v.meta.json").touch()
    remove_if_done(log)
    assert [each.path for each in recordings_in_flight(tmp_path)] == paths[2:3]
    assert [is_in_flight(each) for each in paths] == [False, False, True, False]
    check(read(paths[2]), 3)
    drop(paths[2])
    remove_if_done(log)
    assert list(tmp_path.glob("openaigym.states.*")) == []


def test_a_log_that_an_open_monitor_writes_is_not_removed(
    logs: SpanLogs, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its next recording goes there; also one that begins while it is looked at."""
    lock = Lock(path.parent / lock_name(INFIX), "")
    write(logs, 3)
    drop(path)
    _, log, *_ = files_of(path.parent)
    real = spans._is_open

    def record_late(name: Path) -> bool:
        write(logs, 5, episode=28).end({"complete": True})
        logs.release()
        lock.release()
        return real(name)

    monkeypatch.setattr(spans, "_is_open", record_late)
    remove_if_done(log)
    check(read(episode(path.parent, 28)), 5)
    monkeypatch.undo()
    drop(episode(path.parent, 28))
    remove_if_done(log)
    assert not log.exists()


@pytest.mark.parametrize("more", [-1, 1])
def test_a_journal_by_the_name_of_one_that_was_removed_is_another(
    tmp_path: Path, more: int
) -> None:
    """As where `force` empties a directory; shorter or longer."""
    for number in range(4):
        logs, count = new_logs(tmp_path, INFIX), 4 + more * number
        for each in range(count):
            write(logs, 0, episode=number + 10 * each, facts={"start_time": number})
        in_flight = recordings_in_flight(tmp_path)
        names = [int(each.name[-2:]) for each in in_flight]
        assert names == [number + 10 * each for each in range(count)]
        assert in_flight[0].facts == {"start_time": number}
        logs.release()
        for file in files_of(tmp_path):
            file.unlink(missing_ok=True)


def test_files_that_are_removed_while_they_are_written_cost_one_recording(
    logs: SpanLogs, tmp_path: Path
) -> None:
    """The next one begins another log and another journal, which says all again."""
    write(logs, 3, episode=0)
    for file in files_of(tmp_path):
        file.unlink(missing_ok=True)
    with pytest.raises(FileNotWritten, match="it was removed"):
        write(logs, 3, episode=1)
    write(logs, 3, episode=2)
    assert [each.path for each in recordings_in_flight(tmp_path)] == [
        episode(tmp_path, 2)
    ]
    check(read(episode(tmp_path, 2)), 3)


def test_facts_that_no_line_holds_are_cut_off(logs: SpanLogs, path: Path) -> None:
    """Of the options; what comes behind is read as ever."""
    write(logs, 3, facts={"options": "x" * (1 << 24), "seed": 7})
    write(logs, 3, episode=28, facts={"seed": 8})
    assert len(read(path).facts["options"]["repr"]) == 1000
    assert read(episode(path.parent, 28)).facts == {"seed": 8}


def test_rows_of_a_newer_version_are_no_rows(logs: SpanLogs, path: Path) -> None:
    """They stay, and are told of where they are asked for."""
    write(logs, 3)
    journal, log, *_ = files_of(path.parent)
    journal.write_bytes(journal.read_bytes().replace(b'"version": 1', b'"version": 9'))
    for look in (lambda: read(path), lambda: recordings_in(log)):
        with pytest.raises(UnreadableFile, match="newer mjrec in format version 9"):
            look()
    logs.release()
    remove_if_done(log)
    assert log.exists()


@pytest.mark.parametrize("is_gone", [True, False])
def test_rows_that_no_journal_has_stay(
    logs: SpanLogs, path: Path, is_gone: bool
) -> None:
    """In the tail as in the log; the journal is gone, or its lines are damaged."""
    write(logs, 3)
    journal, log, *_ = files_of(path.parent)
    journal.unlink() if is_gone else journal.write_bytes(b'{"rows": 3}\n{"begin": 4}\n')
    logs.release()
    with pytest.raises(UnreadableFile, match="no journal gives the layout"):
        recordings_in(log)
    remove_if_done(log)
    assert log.exists()
    assert recordings_in_flight(path.parent) == []

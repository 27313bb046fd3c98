# SPDX-License-Identifier: Apache-2.0
"""Recordings in row logs survive the death of their process."""

import itertools
import os
import re
import signal
import struct
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit
from processes import forked, kill_self
from random_rows import ACTION, DTYPE, FACTS, INFIX, NAME, STATE, check, write
from recordings import add_facts, drop
from trajectories_by_hand import add_row, new_logs
from trajectory_contents import content_of

from mjrec.errors import FileNotWritten, UnreadableFile
from mjrec.formats import row_log, span_writer, spans
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import journal_name, lock_name, trajectory_prefix
from mjrec.formats.row_log import TAIL_HEAD, tail_path
from mjrec.formats.trajectory import ModelChange, row_dtype
from mjrec.formats.trajectory_log import open_recording

ROW, CAPACITY = DTYPE.itemsize, 8


@pytest.fixture
def path(tmp_path):
    return tmp_path / f"{NAME}.h5"


@pytest.fixture
def logs(tmp_path):
    return new_logs(tmp_path, INFIX, tail_bytes=CAPACITY * ROW)


def read(path):
    with open_recording(path) as reader:
        return content_of(reader)


def episode(directory, number):
    return directory / f"{trajectory_prefix(INFIX, number)}.h5"


def files_of(directory):
    """Return the paths of the journal, the only log, its tail and its changes."""
    [log] = spans.log_paths(directory)
    journal = directory / journal_name(INFIX)
    return journal, log, tail_path(log), log.with_suffix(".looks")


def model_change(step, **fields):
    return ModelChange(step=step, fields=fields or {"a": np.ones(2)})


@pytest.fixture(params=[True, False], ids=["mapped tail", "no tail"])
def mapped(request, monkeypatch):
    monkeypatch.setattr(row_log, "_may_be_mapped", lambda _: request.param)
    return request.param


def test_counted_rows_are_readable_at_once(logs, path, mapped):
    """An open reader keeps its rows, and closing leaves only the log."""
    span = write(logs, 2)
    journal, log, tail, _ = files_of(path.parent)
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
    assert sorted(path.parent.iterdir()) == sorted([journal, log])


def test_one_log_returns_several_recordings_bit_for_bit(logs, tmp_path):
    """Each recording has its own rows and facts, whether or not it ended."""
    lengths = [3, 0, 17, 40, 2]
    facts = [{**FACTS, "number": 0}, {"number": 1}, {}, {**FACTS, "seed": 8}, FACTS]
    for number, steps in enumerate(lengths):
        span = write(logs, steps, episode=number, every=2, facts=facts[number])
        if number % 2:
            span.end({"complete": True})
    for _ in range(2):
        found = spans.recordings_in_flight(tmp_path)
        assert [each.path for each in found] == [episode(tmp_path, k) for k in range(5)]
        for number, steps in enumerate(lengths):
            content = read(found[number].path)
            check(content, steps, every=2)
            ending = {"complete": True} if number % 2 else {}
            assert (content.facts, content.dropped) == ({**facts[number], **ending}, 0)
        assert len(list(spans.log_paths(tmp_path))) == 1
        logs.close()


def test_model_changes_belong_to_counted_rows(logs, path):
    fields = {"mat_texid": np.array([[1, 2]], ">i4"), "eq_active": np.array([True])}
    span = logs.begin(path.stem, FACTS, DTYPE)
    span.log.add_change(model_change(0, **fields))
    add_row(span, 0)
    span.log.add_change(model_change(1))
    [first] = read(path).model_changes
    add_row(span, 1)
    other = logs.begin(trajectory_prefix(INFIX, 28), FACTS, DTYPE)
    other.log.add_change(model_change(0, b=np.ones(1)))
    add_row(other, 0)
    assert [list(c.fields) for c in read(path).model_changes] == [[*fields], ["a"]]
    [last] = read(episode(path.parent, 28)).model_changes
    assert list(last.fields) == ["b"]
    for name, values in fields.items():
        little = np.asarray(values).astype(values.dtype.newbyteorder("<"))
        np.testing.assert_array_equal(first.fields[name], little, strict=True)


def test_reader_sees_whole_recordings_beside_a_writer(tmp_path):
    """The tail wraps every four rows."""
    path, enough = episode(tmp_path, 0), tmp_path / "enough"

    def record():
        logs = new_logs(tmp_path, INFIX, tail_bytes=1)
        span = logs.begin(path.stem, {}, row_dtype(state=STATE))
        for step in itertools.count():
            if step % 100 == 0:
                if step >= 1000 and enough.exists():
                    break
                span.log.add_change(model_change(step))
            add_row(span, step, state=step, reward=step)
        span.end({"complete": True, "rows": step})
        logs.close()
        os._exit(0)

    process = os.fork()
    if process == 0:
        try:
            record()
        finally:
            os._exit(1)
    try:
        seen, is_over = set(), False
        while not is_over:
            if not spans.is_in_flight(path):
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


def die_writing(function, part, number=1):
    """Make the Nth call of `os.write` or `os.pwrite` write a part and die."""
    real, calls = getattr(os, function), itertools.count(1)

    def write_part(descriptor, data, *offset):
        if next(calls) < number:
            return real(descriptor, data, *offset)
        real(descriptor, part(data), *offset)
        return kill_self()

    setattr(os, function, write_part)


def die_in_slot(rows):
    rows.make_room()
    rows.slots[0] = 5
    kill_self()


def die_in_close(rows):
    Path.unlink = kill_self
    rows.close()


MOMENTS = {
    "within a write": (
        3 * CAPACITY,
        lambda _: die_writing("pwrite", lambda data: data[: len(data) // 2 - 3]),
    ),
    # The log has the tail's rows, but this has not been noted yet.
    "after a write": (3 * CAPACITY, lambda _: die_writing("pwrite", bytes)),
    "refilling the first slot": (3 * CAPACITY, die_in_slot),
    # All rows are in the log, and the tail still exists.
    "in close": (3 * CAPACITY + 2, die_in_close),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_process_loses_no_counted_row(logs, path, mapped, moment):
    count, die = MOMENTS[moment]

    def record(tell):
        span = write(logs, 0)
        for step in itertools.count(1):
            if span.log.count == count:
                die(span.log)
            write(logs, step, first=step, span=span)
            tell()

    steps, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert steps >= 3 * CAPACITY - 1
    # Without a tail, a row counts once it is in the log.
    check(read(path), steps + (not mapped and moment == "after a write"))


@pytest.mark.parametrize("written", [0, 5, 8 * ROW])
def test_interrupted_write_continues(logs, path, monkeypatch, written):
    last = 2 * CAPACITY - 1
    span = write(logs, last)
    real = os.pwrite

    def pwrite(descriptor, data, offset):
        monkeypatch.undo()
        real(descriptor, data[:written], offset)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "pwrite", pwrite)
    with pytest.raises(KeyboardInterrupt):
        write(logs, last + 1, first=last + 1, span=span)
    check(read(path), last)
    write(logs, last + CAPACITY, first=last + 1, span=span)
    logs.close()
    check(read(path), last + CAPACITY)


@pytest.mark.parametrize(
    "part",
    [lambda _: b"", lambda line: line[: len(line) // 2], lambda line: line[:-1], bytes],
    ids=["nothing", "half", "all but the last byte", "all"],
)
@pytest.mark.parametrize("line", range(1, 6))
def test_death_in_a_journal_line_loses_only_that_line(logs, tmp_path, line, part):

    def record(tell):
        die_writing("write", part, line)
        for number in range(2):
            span = write(logs, 5, episode=number)
            tell()
            span.end({"complete": True})

    recorded, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert recorded == (line - 1) // 2
    found = {each.name: each.path for each in spans.recordings_in_flight(tmp_path)}
    lines = ["rows", "begin 0", "end 0", "begin 1", "end 1"]
    written = lines[: line - (part is not bytes)]
    for number in range(2):
        name = trajectory_prefix(INFIX, number)
        assert (name in found) == (f"begin {number}" in written)
        if number < recorded:
            content = read(found[name])
            check(content, 5)
            assert ("complete" in content.facts) == (f"end {number}" in written)
    # Recovery appends to that journal and completes a line without a newline.
    for each in found.values():
        add_facts(each, {"later": 1})
        assert read(each).facts["later"] == 1
    for number in range(2):
        drop(episode(tmp_path, number))
    for left in spans.log_paths(tmp_path):
        spans.remove_if_done(left)
    assert [path.suffix for path in tmp_path.iterdir()] == [".jsonl"]


def test_truncated_log_reports_lost_rows(logs, path):
    """Reading fails if other rows replace those that were lost."""
    write(logs, 5).end({"complete": True})
    write(logs, 5, episode=28).end({"complete": True})
    logs.close()
    _, log, *_ = files_of(path.parent)
    with open_recording(path) as reader:
        for size in range(4 * ROW - 8, 3 * ROW - 1, -8):
            os.truncate(log, size)
            check(read(path), 2)
        with pytest.raises(UnreadableFile, match=r"\.log: its "):
            reader.states(0, 6)
        assert read(path).dropped == 3
        content = read(episode(path.parent, 28))
        assert (len(content.states), content.dropped) == (0, 6)
        log.write_bytes(bytes(100 * ROW))
        with pytest.raises(UnreadableFile, match="changed while being read"):
            reader.snapshots(0, 4)


BAD_TAILS = {
    "short": lambda *_: struct.pack("=2Q", 19, ROW // 8),
    "other row size": lambda *_: tail_head(19, ROW // 8 + 1, CAPACITY),
    "too many rows": lambda *_: tail_head(19, ROW // 8, CAPACITY + 1),
    "no rows": lambda *_: tail_head(19, ROW // 8, 0),
    # These pages are older than the log or were never written.
    "zeros": lambda _, newer: bytes(len(newer)),
    "older": lambda older, _: older,
    "zeros behind the head": lambda _, newer: newer[:4096].ljust(len(newer), b"\0"),
}


def tail_head(*words):
    return struct.pack("=3Q", *words).ljust(TAIL_HEAD + CAPACITY * ROW, b"\0")


@pytest.mark.parametrize("tail", BAD_TAILS)
def test_stale_or_foreign_tail_adds_no_row(logs, path, tail):
    span = write(logs, 12)
    file = files_of(path.parent)[2]
    older = file.read_bytes()
    write(logs, 18, first=13, span=span)
    newer = file.read_bytes()
    logs.release()
    # The log has rows 0 to 15, and the tail has the rest.
    file.write_bytes(BAD_TAILS[tail](older, newer))
    content = read(path)
    check(content, 15)
    assert content.dropped == (3 if tail == "zeros behind the head" else 0)


def test_full_disk_when_a_log_begins_leaves_nothing(logs, path):
    long = {"text": "x" * 20_000}
    for room, facts in ((0, FACTS), (100, FACTS), (4096, FACTS), (9000, long)):
        with file_size_limit(room), pytest.raises(FileNotWritten, match=r"openaigym\."):
            logs.begin(path.stem, facts, DTYPE)
        assert list(spans.log_paths(path.parent)) == []
    write(logs, 3)
    check(read(path), 3)


@pytest.mark.parametrize("room", [0, 30])
def test_journal_lines_wait_for_room_on_a_full_disk(logs, path, room):
    """The journal stays intact, and an end may follow the next beginning."""
    span = write(logs, 3)
    journal, *_ = files_of(path.parent)
    before = journal.read_bytes()
    with file_size_limit(len(before) + room):
        for fail in (
            lambda: add_facts(path, {"candidate": False, "text": "x" * 100}),
            lambda: span.note({"noted": 1, "text": "x" * 100}),
            lambda: span.end({"complete": True}),
            lambda: logs.begin("x", FACTS, DTYPE),
        ):
            with pytest.raises(FileNotWritten, match=rf"{journal.name}: "):
                fail()
        assert journal.read_bytes() == before
        check(read(path), 3)
    write(logs, 5, episode=28)
    content = read(path)
    check(content, 3)
    assert (content.facts["noted"], content.facts["complete"]) == (1, True)
    assert "candidate" not in content.facts
    check(read(episode(path.parent, 28)), 5)


def test_full_disk_costs_no_recorded_step(logs, path, mapped):
    """The step without room is refused or kept in memory."""
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


def test_model_change_can_be_added_again_after_a_full_disk(logs, path):
    span = write(logs, 1)
    span.log.add_change(model_change(2))
    write(logs, 2, first=2, span=span)
    *_, looks = files_of(path.parent)
    texture = model_change(3, tex_data=np.zeros(3 << 20, np.uint8))
    error = pytest.raises(FileNotWritten, match=rf"{looks.name}: ")
    with file_size_limit(looks.stat().st_size + 40), error:
        span.log.add_change(texture)
    span.log.add_change(texture)
    write(logs, 3, first=3, span=span)
    check(read(path), 3)
    found = read(path).model_changes
    assert [list(each.fields) for each in found] == [["a"], ["tex_data"]]


def test_new_log_begins_for_other_rows_and_long_logs(logs, tmp_path, monkeypatch):
    """Recordings that may be deleted alone have logs of their own too."""
    other = row_dtype(state=STATE, action=np.dtype(("<i4", ACTION.shape)))
    monkeypatch.setattr(span_writer, "_LONG", 10 * ROW)
    write(logs, 5, episode=0)
    write(logs, 5, episode=1)
    write(logs, 0, episode=2).log.add_change(model_change(1, t=np.zeros(2 * ROW)))
    write(logs, 0, episode=3)
    write(logs, 0, episode=4, dtype=other)
    for number in (5, 6, 7):
        name = trajectory_prefix(INFIX, number)
        add_row(logs.begin(name, FACTS, other, alone=number < 7), 0)
    found = [
        [r.name[-1:] for r in spans.recordings_in(log)]
        for log in spans.log_paths(tmp_path)
    ]
    assert ["".join(numbers) for numbers in found] == ["01", *"234567"]
    tails = [tail_path(log).exists() for log in spans.log_paths(tmp_path)]
    assert tails == [False] * 6 + [True]
    check(read(episode(tmp_path, 1)), 5)
    check(read(episode(tmp_path, 4)), 0, dtype=other)


def test_log_is_removed_after_its_last_recording(logs, tmp_path):
    """A recording is done once dropped, or once its file or video exists."""
    write(logs, 3, episode=0).log.add_change(model_change(4))
    video = {"kept": False, "video": {"name": "v.mp4"}}
    paths = [episode(tmp_path, number) for number in range(4)]
    for number, facts in enumerate([FACTS, FACTS, video], start=1):
        write(logs, 3, episode=number, facts=facts)
    logs.close()
    log = files_of(tmp_path)[1]
    paths[0].write_bytes(b"a file")
    drop(paths[1])
    (tmp_path / "v.mp4").touch()
    assert spans.is_in_flight(paths[3])
    (tmp_path / "v.meta.json").touch()
    spans.remove_if_done(log)
    assert [each.path for each in spans.recordings_in_flight(tmp_path)] == paths[2:3]
    assert [spans.is_in_flight(each) for each in paths] == [False, False, True, False]
    check(read(paths[2]), 3)
    drop(paths[2])
    spans.remove_if_done(log)
    assert list(tmp_path.glob("openaigym.states.*")) == []


def test_log_of_an_open_monitor_is_not_removed(logs, path, monkeypatch):
    """A recording may begin during the check."""
    lock = Lock(path.parent / lock_name(INFIX), "")
    write(logs, 3)
    drop(path)
    _, log, *_ = files_of(path.parent)
    real = spans._is_open

    def record_late(name):
        write(logs, 5, episode=28).end({"complete": True})
        logs.release()
        lock.release()
        return real(name)

    monkeypatch.setattr(spans, "_is_open", record_late)
    spans.remove_if_done(log)
    check(read(episode(path.parent, 28)), 5)
    monkeypatch.undo()
    drop(episode(path.parent, 28))
    spans.remove_if_done(log)
    assert not log.exists()


@pytest.mark.parametrize("more", [-1, 1])
def test_new_journal_replaces_a_removed_one_of_the_same_name(tmp_path, more):
    """The argument `force` removes files in the same way."""
    for number in range(4):
        logs, count = new_logs(tmp_path, INFIX), 4 + more * number
        for each in range(count):
            write(logs, 0, episode=number + 10 * each, facts={"start_time": number})
        in_flight = spans.recordings_in_flight(tmp_path)
        names = [int(each.name[-2:]) for each in in_flight]
        assert names == [number + 10 * each for each in range(count)]
        assert in_flight[0].facts == {"start_time": number}
        logs.release()
        for file in files_of(tmp_path):
            file.unlink(missing_ok=True)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (rb'"version": 1', b'"version": 9', "newer mjrec in format version 9"),
        (b"(?s).+", b'{"rows": 3}\n{"begin": 4}\n', "no journal gives the layout"),
        (b"(?s).+", b"", "no journal gives the layout"),
    ],
    ids=["newer", "damaged", "gone"],
)
def test_rows_without_a_readable_journal_stay(logs, path, old, new, reason):
    write(logs, 3)
    journal, log, *_ = files_of(path.parent)
    journal.write_bytes(re.sub(old, new, journal.read_bytes()))
    if not new:
        journal.unlink()
    with pytest.raises(UnreadableFile, match=reason):
        spans.recordings_in(log)
    logs.release()
    spans.remove_if_done(log)
    assert log.exists()


def test_removing_open_files_costs_one_recording(logs, tmp_path):
    """The next recording starts another log and a complete journal."""
    write(logs, 3, episode=0)
    for file in files_of(tmp_path):
        file.unlink(missing_ok=True)
    with pytest.raises(FileNotWritten, match="it was removed"):
        write(logs, 3, episode=1)
    write(logs, 3, episode=2)
    [found] = spans.recordings_in_flight(tmp_path)
    check(read(found.path), 3)

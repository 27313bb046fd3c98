# SPDX-License-Identifier: Apache-2.0
"""Recordings in a monitor's row logs are there whatever becomes of the process."""

import itertools
import os
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
    """The file that the recording will be."""
    return tmp_path / f"{NAME}.h5"


@pytest.fixture
def logs(tmp_path):
    """Logs whose tails hold eight rows."""
    return new_logs(tmp_path, INFIX, tail_bytes=CAPACITY * ROW)


def read(path):
    with open_recording(path) as reader:
        return content_of(reader)


def episode(directory, number):
    return directory / f"{trajectory_prefix(INFIX, number)}.h5"


def files_of(directory):
    """Return the journal, and the only log there is, its tail and its changes."""
    [log] = spans.log_paths(directory)
    journal = directory / journal_name(INFIX)
    return journal, log, tail_path(log), log.with_suffix(".looks")


def change(step, **fields):
    return ModelChange(step=step, fields=fields or {"a": np.ones(2)})


@pytest.fixture(params=[True, False], ids=["a mapped tail", "no tail"])
def mapped(request, monkeypatch):
    """Whether the file system has mappings that outlive a process."""
    monkeypatch.setattr(row_log, "_may_be_mapped", lambda _: request.param)
    return request.param


def test_rows_are_there_as_soon_as_they_are_counted(logs, path, mapped):
    """Wherever the tail wraps, also for an open reader; then the log is alone."""
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


def test_recordings_of_one_log_come_back_bit_for_bit(logs, tmp_path):
    """Each has its own rows and facts, ended or not; the last is written still."""
    lengths = [3, 0, 17, 40, 2]
    said = [{**FACTS, "number": 0}, {"number": 1}, {}, {**FACTS, "seed": 8}, FACTS]
    for number, steps in enumerate(lengths):
        span = write(logs, steps, episode=number, every=2, facts=said[number])
        if number % 2:
            span.end({"complete": True})
    for _ in range(2):
        found = spans.recordings_in_flight(tmp_path)
        assert [each.path for each in found] == [episode(tmp_path, k) for k in range(5)]
        for number, steps in enumerate(lengths):
            content = read(found[number].path)
            check(content, steps, every=2)
            ending = {"complete": True} if number % 2 else {}
            assert (content.facts, content.dropped) == ({**said[number], **ending}, 0)
        assert len(list(spans.log_paths(tmp_path))) == 1
        logs.close()


def test_model_changes_come_back(logs, path):
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
    [first] = read(path).model_changes
    add_row(span, 1)
    other = logs.begin(trajectory_prefix(INFIX, 28), FACTS, DTYPE)
    other.log.add_change(change(0, b=np.ones(1)))
    add_row(other, 0)
    assert [list(c.fields) for c in read(path).model_changes] == [[*fields], ["a"]]
    [last] = read(episode(path.parent, 28)).model_changes
    assert list(last.fields) == ["b"]
    for name, values in fields.items():
        little = np.asarray(values).astype(values.dtype.newbyteorder("<"))
        np.testing.assert_array_equal(first.fields[name], little, strict=True)


def test_a_reader_beside_a_writer_sees_whole_recordings(tmp_path):
    """With all changes to the model, though the tail wraps with every fourth row."""
    path, enough = episode(tmp_path, 0), tmp_path / "enough"

    def record():
        logs = new_logs(tmp_path, INFIX, tail_bytes=1)
        span = logs.begin(path.stem, {}, row_dtype(state=STATE))
        for step in itertools.count():
            if step % 100 == 0:
                if step >= 1000 and enough.exists():
                    break
                span.log.add_change(change(step))
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
    """Have the Nth call of `os.write` or `os.pwrite` write a part, and die."""
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
    # With some rows of a full tail in the log, and half of one.
    "in the middle of a write": (
        3 * CAPACITY,
        lambda _: die_writing("pwrite", lambda data: data[: len(data) // 2 - 3]),
    ),
    # With a full tail in the log, which is not noted yet.
    "after a write": (3 * CAPACITY, lambda _: die_writing("pwrite", bytes)),
    # When the first slot of a tail that was written is filled again.
    "in the next slot": (3 * CAPACITY, die_in_slot),
    # With all rows in the log, before the tail is removed.
    "in a close": (3 * CAPACITY + 2, die_in_close),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_process_loses_no_counted_row(logs, path, mapped, moment):
    """At any moment; nothing was flushed, and no signal's handler was called."""
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
    # Without a tail a row counts as soon as it is in the log.
    check(read(path), steps + (not mapped and moment == "after a write"))


@pytest.mark.parametrize("written", [0, 5, 8 * ROW])
def test_an_interrupted_write_is_taken_up_again(logs, path, monkeypatch, written):
    """After Ctrl-C at any byte of it; each row is there once."""
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
def test_a_process_killed_in_a_line_of_the_journal_loses_nothing_else(
    logs, tmp_path, line, part
):
    """What was recorded before is there; what was being said is said or is not."""

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
    said = lines[: line - (part is not bytes)]
    for number in range(2):
        name = trajectory_prefix(INFIX, number)
        assert (name in found) == (f"begin {number}" in said)
        if number < recorded:
            content = read(found[name])
            check(content, 5)
            assert ("complete" in content.facts) == (f"end {number}" in said)
    # A recovery goes on in that journal.
    for each in found.values():
        add_facts(each, {"later": 1})
        assert read(each).facts["later"] == 1
    for number in range(2):
        # Also one whose line lacked its end only, which it has by now.
        drop(episode(tmp_path, number))
    for left in spans.log_paths(tmp_path):
        spans.remove_if_done(left)
    assert [path.suffix for path in tmp_path.iterdir()] == [".jsonl"]


def test_lost_rows_of_an_ended_recording_are_counted(logs, path):
    """Cut at every word, also while it is read; rows of something else are an error."""
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
    # What it says would lead beyond it, or to rows of another size.
    "short": lambda *_: struct.pack("=2Q", 19, ROW // 8),
    "of other rows": lambda *_: tail_head(19, ROW // 8 + 1, CAPACITY),
    "beyond its end": lambda *_: tail_head(19, ROW // 8, CAPACITY + 1),
    "without rows": lambda *_: tail_head(19, ROW // 8, 0),
    # Its pages are older than the log, or never were written.
    "zeros": lambda _, newer: bytes(len(newer)),
    "older": lambda older, _: older,
    "zeros behind the head": lambda _, newer: newer[:4096].ljust(len(newer), b"\0"),
}


def tail_head(*words):
    return struct.pack("=3Q", *words).ljust(TAIL_HEAD + CAPACITY * ROW, b"\0")


@pytest.mark.parametrize("tail", BAD_TAILS)
def test_a_tail_of_something_else_or_older_ends_a_recording(logs, path, tail):
    """No row is invented."""
    span = write(logs, 12)
    file = files_of(path.parent)[2]
    older = file.read_bytes()
    write(logs, 18, first=13, span=span)
    newer = file.read_bytes()
    logs.release()
    # The log has rows 0 to 15, the tail of 8 rows those from 16 on.
    file.write_bytes(BAD_TAILS[tail](older, newer))
    content = read(path)
    check(content, 15)
    assert content.dropped == (3 if tail == "zeros behind the head" else 0)


def test_a_full_disk_when_a_log_is_made_leaves_nothing(logs, path):
    """Its tail finds no room, or the journal; with room again it is begun."""
    long = {"text": "x" * 20_000}
    for room, facts in ((0, FACTS), (100, FACTS), (4096, FACTS), (9000, long)):
        with file_size_limit(room), pytest.raises(FileNotWritten, match=r"openaigym\."):
            logs.begin(path.stem, facts, DTYPE)
        assert list(spans.log_paths(path.parent)) == []
    write(logs, 3)
    check(read(path), 3)


@pytest.mark.parametrize("room", [0, 30])
def test_what_a_full_disk_did_not_let_be_said_is_said_later(logs, path, room):
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


def test_a_full_disk_costs_no_step_that_was_recorded(logs, path, mapped):
    """The step without room is refused, or kept in memory; with room all goes on."""
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


def test_a_change_on_a_full_disk_can_be_added_again(logs, path):
    """The error names the file; what was added before stays, and nothing of this."""
    span = write(logs, 1)
    span.log.add_change(change(2))
    write(logs, 2, first=2, span=span)
    *_, looks = files_of(path.parent)
    texture = change(3, tex_data=np.zeros(3 << 20, np.uint8))
    said = pytest.raises(FileNotWritten, match=rf"{looks.name}: ")
    with file_size_limit(looks.stat().st_size + 40), said:
        span.log.add_change(texture)
    span.log.add_change(texture)
    write(logs, 3, first=3, span=span)
    check(read(path), 3)
    found = read(path).model_changes
    assert [list(each.fields) for each in found] == [["a"], ["tex_data"]]


def test_a_log_ends_where_the_next_rows_do_not_belong(logs, tmp_path, monkeypatch):
    """Of another kind, to be deleted alone, or behind many; changes count as rows."""
    other = row_dtype(state=STATE, action=np.dtype(("<i4", ACTION.shape)))
    monkeypatch.setattr(span_writer, "_LONG", 10 * ROW)
    write(logs, 5, episode=0)
    write(logs, 5, episode=1)
    write(logs, 0, episode=2).log.add_change(change(1, t=np.zeros(2 * ROW)))
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


def test_a_log_of_which_nothing_is_needed_is_removed(logs, tmp_path):
    """With its files, when the last of its recordings is dropped, a file, a video."""
    write(logs, 3, episode=0).log.add_change(change(4))
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


def test_a_log_that_an_open_monitor_writes_is_not_removed(logs, path, monkeypatch):
    """Its next recording goes there; also one that begins while it is looked at."""
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
def test_a_journal_by_the_name_of_one_that_was_removed_is_another(tmp_path, more):
    """As where `force` empties a directory; shorter or longer."""
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
    ("said", "reason"),
    [
        (
            lambda text: text.replace(b'"version": 1', b'"version": 9'),
            "newer mjrec in format version 9",
        ),
        (lambda _: b'{"rows": 3}\n{"begin": 4}\n', "no journal gives the layout"),
        (None, "no journal gives the layout"),
    ],
    ids=["newer", "damaged", "gone"],
)
def test_rows_that_no_journal_describes_stay(logs, path, said, reason):
    """In the tail as in the log; the error says why where they are asked for."""
    write(logs, 3)
    journal, log, *_ = files_of(path.parent)
    text = journal.read_bytes()
    journal.unlink() if said is None else journal.write_bytes(said(text))
    with pytest.raises(UnreadableFile, match=reason):
        spans.recordings_in(log)
    logs.release()
    spans.remove_if_done(log)
    assert log.exists()


def test_files_that_are_removed_while_they_are_written_cost_one_recording(
    logs, tmp_path
):
    """The next one begins another log and another journal, which says all again."""
    write(logs, 3, episode=0)
    for file in files_of(tmp_path):
        file.unlink(missing_ok=True)
    with pytest.raises(FileNotWritten, match="it was removed"):
        write(logs, 3, episode=1)
    write(logs, 3, episode=2)
    [found] = spans.recordings_in_flight(tmp_path)
    check(read(found.path), 3)

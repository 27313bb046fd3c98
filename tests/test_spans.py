# SPDX-License-Identifier: Apache-2.0
"""Recordings in a monitor's row logs are there whatever becomes of the process."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import os
import shutil
import signal
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from full_disk import file_size_limit
from processes import forked, kill_self
from trajectories_by_hand import add_row, new_logs
from trajectory_contents import TrajectoryContent, content_of

import mjrec.formats.span_writer as span_writer
from mjrec.errors import FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats import in_flight
from mjrec.formats.in_flight import (
    add_facts,
    drop_recording,
    is_in_flight,
    list_paths,
    read_list,
    recordings_in_flight,
    remove_if_done,
)
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import (
    Infix,
    clip_part_name,
    lock_name,
    trajectory_prefix,
)
from mjrec.formats.row_log import tail_path
from mjrec.formats.span_reader import SpanReader
from mjrec.formats.span_writer import LOOK_PREFIX, SpanLogs, SpanWriter
from mjrec.formats.spans import append_line, row_dtype
from mjrec.formats.trajectory import (
    Array,
    Field,
    ModelChange,
    RowLayout,
    StateComponent,
    TrajectoryHeader,
)

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
INFIX = Infix(0, "1")
NAN = struct.pack("<Q", 0x7FF8000000BADBAD)
ROW = row_dtype(HEADER).itemsize
NAME = trajectory_prefix(INFIX, 27)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file that the recording will be."""
    return tmp_path / f"{NAME}.h5"


def small_logs(directory: Path, infix: Infix = INFIX) -> SpanLogs:
    """Return logs whose tails hold few rows."""
    return SpanLogs(directory, infix, numbers=itertools.count(), tail_bytes=1)


def pattern(step: int, factor: int, kind: Array) -> Any:
    data = bytes((step * factor + i) % 251 for i in range(kind.size))
    if kind.dtype == "<f8":
        data = NAN + data[8:]
    return np.frombuffer(data, kind.dtype).reshape(kind.shape)


def snapshot_of(step: int) -> Any:
    # What lies between the arrays may be anything.
    return pattern(step, 11, Array("|u1", (HEADER.snapshot.size,)))


def write_step(span: SpanWriter, step: int, *, frame: bool = True) -> None:
    assert HEADER.action
    assert HEADER.observation
    add_row(
        span,
        step,
        state=pattern(step, 3, Array("<f8", (3,))),
        action=pattern(step, 5, HEADER.action),
        observation=pattern(step, 7, HEADER.observation),
        reward=step / 3,
        terminated=step == 8,
        truncated=step == 9,
        **({"snapshot": snapshot_of(step)} if frame else {}),
    )


def write(
    logs: SpanLogs, steps: int, *, episode: int = 27, every: int = 1, **facts: Any
) -> SpanWriter:
    """Record an episode, without an end."""
    header = dataclasses.replace(HEADER, facts={**HEADER.facts, **facts})
    span = logs.begin(trajectory_prefix(INFIX, episode), header)
    for step in range(steps + 1):
        write_step(span, step, frame=step % every == 0)
    return span


def read(path: Path) -> TrajectoryContent:
    with SpanReader(path) as reader:
        return content_of(reader)


def check(content: TrajectoryContent, steps: int, *, every: int = 1) -> None:
    """Check that a recording has exactly what `write` wrote."""
    assert HEADER.action
    assert HEADER.observation
    assert content.actions is not None
    assert content.observations is not None
    numbers = range(steps + 1)
    states = [pattern(k, 3, Array("<f8", (3,))).tobytes() for k in numbers]
    actions = [pattern(k, 5, HEADER.action).tobytes() for k in numbers[1:]]
    observations = [pattern(k, 7, HEADER.observation).tobytes() for k in numbers]
    assert content.states.tobytes() == b"".join(states)
    assert content.actions.tobytes() == b"".join(actions)
    assert content.actions.shape == (steps, 3)
    assert content.observations.tobytes() == b"".join(observations)
    assert content.rewards.tolist() == [k / 3 for k in numbers[1:]]
    assert content.terminated.tolist() == [k == 8 for k in numbers[1:]]
    assert content.truncated.tolist() == [k == 9 for k in numbers[1:]]
    assert content.frame_steps.tolist() == list(numbers[::every])
    snapshots = np.array([snapshot_of(k) for k in numbers[::every]])
    snapshots[:, HEADER.snapshot.padding] = 0
    assert content.snapshots.tobytes() == snapshots.tobytes()


def files_of(directory: Path) -> tuple[Path, Path, Path, Path]:
    """Return the list, the log, its tail and the changes of the only log there is."""
    [spans] = list_paths(directory)
    log = spans.with_suffix(".log")
    return spans, log, tail_path(log), spans.with_suffix(".looks")


# --- what was written comes back -----------------------------------------------------


def test_everything_comes_back_bit_for_bit(path: Path) -> None:
    """Rows, flags and facts are read as they were written; NaNs keep their payload."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 9, every=3)
    span.end({"complete": True})
    for _ in range(2):
        content = read(path)
        check(content, 9, every=3)
        assert content.header.facts == {**HEADER.facts, "complete": True}
        assert dataclasses.replace(content.header, facts=HEADER.facts) == HEADER
        assert content.dropped == 0
        logs.close()


def test_recordings_follow_each_other_in_one_log(tmp_path: Path) -> None:
    """Each has its own rows and facts, ended or not; the last is written still."""
    logs = small_logs(tmp_path)
    lengths = [3, 0, 17, 40, 2]
    for episode, steps in enumerate(lengths):
        span = write(logs, steps, episode=episode, number=episode, **{f"e{episode}": 1})
        if episode % 2:
            span.end({"complete": True})
    found = recordings_in_flight(tmp_path)
    assert len(list(list_paths(tmp_path))) == 1
    assert [each.name for each in found] == [
        trajectory_prefix(INFIX, episode) for episode in range(5)
    ]
    for episode, steps in enumerate(lengths):
        content = read(found[episode].path)
        check(content, steps)
        ending = {"complete": True} if episode % 2 else {}
        expected = {**HEADER.facts, "number": episode, f"e{episode}": 1, **ending}
        assert content.header.facts == expected


# --- facts ---------------------------------------------------------------------------


def test_facts_that_come_later_replace_those_before(path: Path) -> None:
    """The newest value of a key counts, whoever adds it, also behind the end."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 1)
    span.note({"rate": "20", "seed": 8})
    add_facts(path, {"video": None, "nan": float("nan")})
    span.end({"complete": True})
    logs.close()
    add_facts(path, {"rate": "30"})
    added = {"rate": "30", "seed": 8, "video": None, "nan": None, "complete": True}
    assert read(path).header.facts == {**HEADER.facts, **added}


def test_facts_of_one_recording_are_not_those_of_the_next(tmp_path: Path) -> None:
    """Though a log says once only what is true of all."""
    logs = new_logs(tmp_path, INFIX)
    for episode, facts in enumerate([{"a": 1, "b": [2]}, {"b": [3]}, {"a": 1}, {}]):
        header = dataclasses.replace(HEADER, facts=facts)
        span = logs.begin(trajectory_prefix(INFIX, episode), header)
        assert (
            read(logs.path_of(trajectory_prefix(INFIX, episode))).header.facts == facts
        )
        span.note({"a": 9})


@pytest.mark.parametrize("room", [0, 1, 30])
def test_facts_on_a_full_disk_leave_the_list_as_it_was(path: Path, room: int) -> None:
    """Half a line would be nobody's; the error names the file."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    spans, *_ = files_of(path.parent)
    before = spans.read_bytes()
    with file_size_limit(len(before) + room):
        with pytest.raises(FileNotWritten, match=rf"{spans.name}: "):
            add_facts(path, {"candidate": False, "text": "x" * 100})
        # What the recorder notes waits for the next thing that it says.
        span.note({"noted": 1, "text": "x" * 100})
        for _ in range(2):
            with pytest.raises(FileNotWritten):
                span.end({"complete": True})
        assert spans.read_bytes() == before
        check(read(path), 3)
    span.end({"complete": False})
    facts = read(path).header.facts
    assert (facts["noted"], facts["complete"]) == (1, True)
    assert "candidate" not in facts


# --- changes of the model ------------------------------------------------------------


def test_model_changes_come_back(path: Path) -> None:
    """Names, kinds and values of changed fields, and the step that they hold from."""
    logs = new_logs(path.parent, INFIX)
    fields = {
        "geom_rgba": np.arange(8, dtype=np.float32).reshape(2, 4),
        "opt.gravity": np.array([0, 0, -9.81]),
        "stat.extent": np.float64(2.5),
        "mat_texid": np.array([[1, 2]], ">i4"),
        "eq_active": np.array([True]),
        "hfield_data": np.empty((0, 3), np.float32),
    }
    span = logs.begin(path.stem, HEADER)
    span.add_change(ModelChange(step=0, fields=fields))
    write_step(span, 0)
    span.add_change(ModelChange(step=1, fields={}))
    write_step(span, 1)
    other = logs.begin(trajectory_prefix(INFIX, 28), HEADER)
    other.add_change(ModelChange(step=0, fields={"b": np.ones(1)}))
    write_step(other, 0)
    first, second = read(path).model_changes
    assert (first.step, second.step, second.fields) == (0, 1, {})
    assert list(first.fields) == list(fields)
    for name, values in fields.items():
        np.testing.assert_array_equal(first.fields[name], values)
        assert first.fields[name].shape == values.shape
        assert first.fields[name].dtype == values.dtype.newbyteorder("<")
    [last] = read(logs.path_of(trajectory_prefix(INFIX, 28))).model_changes
    assert list(last.fields) == ["b"]


def test_a_change_is_that_of_the_row_that_shows_it(path: Path) -> None:
    """Of a row that was never counted there is no change either."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    change = ModelChange(step=4, fields={"a": np.ones(2)})
    span.add_change(change)
    assert read(path).model_changes == ()
    write_step(span, 4)
    assert [c.step for c in read(path).model_changes] == [4]


@pytest.mark.parametrize("size", [8, 3 << 20])
def test_a_change_on_a_full_disk_can_be_added_again(path: Path, size: int) -> None:
    """The error names the file; what was added before stays, and nothing of this."""
    span = write(new_logs(path.parent, INFIX), 1)
    span.add_change(ModelChange(step=2, fields={"a": np.ones(2)}))
    write_step(span, 2)
    *_, looks = files_of(path.parent)
    change = ModelChange(step=3, fields={"tex_data": np.zeros(size, np.uint8)})
    with (
        file_size_limit(looks.stat().st_size + 40),
        pytest.raises(FileNotWritten, match=rf"{looks.name}: "),
    ):
        span.add_change(change)
    assert [c.step for c in read(path).model_changes] == [2]
    span.add_change(change)
    write_step(span, 3)
    content = read(path)
    check(content, 3)
    assert [list(c.fields) for c in content.model_changes] == [["a"], ["tex_data"]]


@pytest.mark.parametrize(
    ("name", "values"), [("a", np.array(["text"])), ("a/b", np.zeros(1))]
)
def test_what_no_file_can_hold_is_refused_as_a_change(
    path: Path, name: str, values: np.ndarray
) -> None:
    """The error names the field; the log goes on."""
    span = write(new_logs(path.parent, INFIX), 3)
    with pytest.raises(InvalidArgument, match=f"The model field '{name}'"):
        span.add_change(ModelChange(step=0, fields={name: values}))
    write_step(span, 4)
    check(read(path), 4)


# --- rows ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (
            {"snapshot": RowLayout((Field("geom_xpos", Array("<f8", (1,)), 8),))},
            "do not lie one behind the other",
        ),
        ({"action": Array(">f8", (1,))}, "'>f8' is no dtype"),
    ],
)
def test_what_no_file_can_hold_is_refused_as_a_row(
    path: Path, rows: dict[str, Any], reason: str
) -> None:
    """A layout that a reader would not accept is not written, and no file is made."""
    with pytest.raises(InvalidArgument, match=reason):
        new_logs(path.parent, INFIX).begin(
            path.stem, TrajectoryHeader(facts={}, **rows)
        )
    assert list(path.parent.iterdir()) == []


def test_a_recording_without_steps_can_be_read(path: Path) -> None:
    """Nothing but a beginning, or the row of the reset alone."""
    span = new_logs(path.parent, INFIX).begin(path.stem, HEADER)
    content = read(path)
    assert content.states.shape == (0, 3)
    assert content.actions is not None
    assert content.actions.shape == (0, 3)
    assert content.snapshots.shape == (0, HEADER.snapshot.size)
    write_step(span, 0)
    check(read(path), 0)


def test_a_frame_may_follow_its_step(path: Path) -> None:
    """In a row of its own, as the last picture of an interrupted episode."""
    span = write(new_logs(path.parent, INFIX), 3, every=2)
    add_row(span, 3, is_step=False, snapshot=snapshot_of(3))
    content = read(path)
    assert content.frame_steps.tolist() == [0, 2, 3]
    assert len(content.states) == 4
    assert (span.last_frame, span.frame_count, span.size) == (3, 3, 5 * ROW)


def test_rows_may_be_larger_than_the_tail(path: Path) -> None:
    """Observations of 300 KiB."""
    header = TrajectoryHeader(facts={}, observation=Array("|u1", (300 << 10,)))
    logs = new_logs(path.parent, INFIX)
    span = logs.begin(path.stem, header)
    for step in range(11):
        add_row(span, step, observation=step)
        with SpanReader(path) as reader:
            found = reader.observations(0, step + 1)
        assert found is not None
        assert (found == np.arange(step + 1)[:, None]).all()


# --- what is written while it is read ------------------------------------------------


def test_a_living_recording_can_be_read(path: Path) -> None:
    """A reader has what there was when it was opened, and keeps it."""
    logs = small_logs(path.parent)
    span = write(logs, 2)
    with SpanReader(path) as reader:
        for step in range(3, 20):
            write_step(span, step)
        check(content_of(reader), 2)
        logs.close()
        check(content_of(reader), 2)
    check(read(path), 19)


def test_readers_beside_a_writer_see_whole_recordings(tmp_path: Path) -> None:
    """With all changes of the model, though the tail wraps with every fourth row."""
    episodes, steps = 3, 3000
    go = tmp_path / "go"

    def record() -> None:
        logs = small_logs(tmp_path)
        for episode in range(episodes):
            header = TrajectoryHeader(facts={}, state=HEADER.state)
            span = logs.begin(trajectory_prefix(INFIX, episode), header)
            for step in range(steps + 1):
                if step % 100 == 0:
                    span.add_change(ModelChange(step=step, fields={}))
                add_row(span, step, state=step, reward=step)
            span.end({"complete": True})
        logs.close()

    process = os.fork()
    if process == 0:
        try:
            while not go.exists():
                pass
            record()
            os._exit(0)
        finally:
            os._exit(1)
    go.touch()
    looks = set()
    for episode in range(episodes):
        path = tmp_path / f"{trajectory_prefix(INFIX, episode)}.h5"
        is_over = False
        while not is_over:
            if not is_in_flight(path):
                continue
            with SpanReader(path) as reader:
                is_over = "complete" in reader.header.facts
                count = reader.row_count
                looks.add((episode, count))
                assert reader.dropped == 0
                assert reader.rewards.tolist() == list(range(1, count))
                states = reader.states(0, count)
                assert (states == np.arange(count)[:, None]).all()
                changes = [change.step for change in reader.model_changes]
                assert changes == list(range(0, count, 100))
        assert count == steps + 1
    assert os.waitpid(process, 0)[1] == 0
    assert len(looks) > episodes


def test_many_threads_may_read_one_list(tmp_path: Path) -> None:
    """What one of them has read, none of the others reads twice or passes over."""
    logs = new_logs(tmp_path, INFIX)
    count = 300
    problems: list[object] = []

    def look() -> None:
        try:
            seen = 0
            while seen < count:
                found = len(recordings_in_flight(tmp_path))
                assert found >= seen
                seen = found
        except BaseException as error:
            problems.append(error)
            raise

    threads = [threading.Thread(target=look) for _ in range(4)]
    for thread in threads:
        thread.start()
    for episode in range(count):
        write(logs, 0, episode=episode).end({"complete": True})
    for thread in threads:
        thread.join()
    assert problems == []


# --- a process that is killed --------------------------------------------------------


def kill_in_line(number: int, part: Callable[[bytes], bytes]) -> None:
    """Have this process die in the writing of a line of a list."""
    real, lines = os.write, itertools.count(1)

    def write(descriptor: int, data: bytes) -> int:
        if next(lines) < number:
            return real(descriptor, data)
        real(descriptor, part(data))
        kill_self()
        return 0

    os.write = write


PARTS: dict[str, Callable[[bytes], bytes]] = {
    "before": lambda line: b"",
    "in the first byte": lambda line: line[:1],
    "in the middle": lambda line: line[: len(line) // 2],
    "before the last byte": lambda line: line[:-1],
    "behind": lambda line: line,
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("line", range(1, 6))
def test_a_process_killed_in_a_line_of_the_list_loses_nothing_else(
    tmp_path: Path, line: int, part: str
) -> None:
    """What was recorded before is there; what was being said is said or is not."""
    lines = ["head", "begin 0", "end 0", "begin 1", "end 1"]

    def record(tell: Callable[[], object]) -> None:
        kill_in_line(line, PARTS[part])
        logs = small_logs(tmp_path)
        for episode in range(2):
            span = write(logs, 5, episode=episode)
            tell()
            span.end({"complete": True})

    recorded, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert recorded == (line - 1) // 2
    found = {each.name: each.path for each in recordings_in_flight(tmp_path)}
    said = lines[: line - (part != "behind")]
    for episode in range(2):
        name = trajectory_prefix(INFIX, episode)
        assert (name in found) == (f"begin {episode}" in said)
        if episode < recorded:
            content = read(found[name])
            check(content, 5)
            assert ("complete" in content.header.facts) == (f"end {episode}" in said)
    # Somebody puts things in order.
    for path in found.values():
        add_facts(path, {"later": 1})
        assert read(path).header.facts["later"] == 1
        drop_recording(path)
    for spans in list_paths(tmp_path):
        remove_if_done(spans)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("is_mapped", [True, False])
@pytest.mark.parametrize("steps", [0, 3, 4, 30])
def test_a_killed_process_loses_no_step(
    path: Path, monkeypatch: pytest.MonkeyPatch, is_mapped: bool, steps: int
) -> None:
    """With half of the next row filled, and its change of the model written."""
    monkeypatch.setattr("mjrec.formats.row_log._may_be_mapped", lambda _: is_mapped)

    def record(tell: Callable[[], object]) -> None:
        span = write(small_logs(path.parent), steps)
        tell()
        slot = span.make_room()
        span.add_change(ModelChange(step=steps + 1, fields={"a": np.ones(1)}))
        span.log.columns["state"][slot] = 5
        span.log.columns["row"][slot] = span.log.rows.count
        kill_self()

    assert forked(record) == (1, signal.SIGKILL)
    content = read(path)
    check(content, steps)
    assert content.model_changes == ()
    assert content.dropped == 0


@pytest.mark.parametrize("size", range(1, 60, 7))
def test_a_torn_line_at_the_end_is_passed_over(path: Path, size: int) -> None:
    """Wherever it was torn; what is added behind it is read."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    spans, *_ = files_of(path.parent)
    whole = spans.stat().st_size
    add_facts(path, {"late": "1" * 60})
    assert spans.stat().st_size > whole + size
    os.truncate(spans, whole + size)
    assert "late" not in read(path).header.facts
    add_facts(path, {"late": 2})
    span.end({"complete": True})
    facts = read(path).header.facts
    assert (facts["late"], facts["complete"]) == (2, True)
    check(read(path), 3)


# --- a machine that crashed ----------------------------------------------------------


def test_a_log_torn_anywhere_keeps_the_whole_rows(path: Path) -> None:
    """Cut at every byte of its last row: the rows before are there."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 5)
    logs.close()
    _, log, *_ = files_of(path.parent)
    assert log.stat().st_size == 6 * ROW
    for size in reversed(range(5 * ROW, 6 * ROW, 8)):
        os.truncate(log, size)
        check(read(path), 4)


def test_lost_rows_of_an_ended_recording_are_counted(path: Path) -> None:
    """The list says how many there were; those of the next one are lost as well."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 5).end({"complete": True})
    write(logs, 5, episode=28).end({"complete": True})
    logs.close()
    _, log, *_ = files_of(path.parent)
    os.truncate(log, 3 * ROW)
    assert read(path).dropped == 3
    check(read(path), 2)
    [_, other] = recordings_in_flight(path.parent)
    content = read(other.path)
    assert (len(content.states), content.dropped) == (0, 6)


@pytest.mark.parametrize("stale", ["zeros", "an older tail", "zeros behind the head"])
def test_a_stale_tail_ends_a_recording(
    path: Path, monkeypatch: pytest.MonkeyPatch, stale: str
) -> None:
    """Its pages are older than the log, or never were written: no row is invented."""
    logs = SpanLogs(path.parent, INFIX, numbers=itertools.count(), tail_bytes=8 * ROW)
    span = write(logs, 12)
    _, _, tail, _ = files_of(path.parent)
    older = tail.read_bytes()
    for step in range(13, 19):
        write_step(span, step)
    newer = tail.read_bytes()
    logs.release()
    # The log has rows 0 to 15, the tail of 8 rows those from 16 on.
    tail.write_bytes(
        {
            "zeros": bytes(len(newer)),
            "an older tail": older,
            "zeros behind the head": newer[:4096] + bytes(len(newer) - 4096),
        }[stale]
    )
    check(read(path), 15)
    assert read(path).dropped == (3 if stale == "zeros behind the head" else 0)


@pytest.mark.parametrize(
    ("rows", "states", "frames"),
    [
        ([(1, True)], 0, []),
        ([(0, True), (2, True)], 1, [0]),
        ([(0, True), (1, True), (1, True)], 2, [0, 1]),
        ([(0, True), (1, True), (2, False)], 2, [0, 1]),
        ([(0, False)], 0, []),
    ],
)
def test_rows_out_of_order_end_a_recording(
    path: Path, rows: list[tuple[int, bool]], states: int, frames: list[int]
) -> None:
    """States, actions and frames belong together by their places."""
    span = new_logs(path.parent, INFIX).begin(path.stem, HEADER)
    for step, is_step in rows:
        add_row(span, step, is_step=is_step, snapshot=0)
    content = read(path)
    assert (len(content.states), content.dropped) == (states, 1)
    assert content.frame_steps.tolist() == frames


# --- a full disk ---------------------------------------------------------------------


def test_a_full_disk_when_a_log_is_made_leaves_nothing(path: Path) -> None:
    """Neither its list nor its tail finds room; with room again it is begun."""
    logs = new_logs(path.parent, INFIX)
    for room in (0, 100, 4096):
        with (
            file_size_limit(room),
            pytest.raises(FileNotWritten, match=r"openaigym\.states\.0\.1\.\d+\."),
        ):
            logs.begin(path.stem, HEADER)
        assert list(path.parent.iterdir()) == []
    write(logs, 3)
    check(read(path), 3)


def test_what_a_full_disk_did_not_let_be_said_is_said_later(path: Path) -> None:
    """The end of a recording, also behind the next one, which it did not let begin."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    spans, *_ = files_of(path.parent)
    with file_size_limit(spans.stat().st_size + 20):
        with pytest.raises(FileNotWritten):
            span.end({"complete": True})
        with pytest.raises(FileNotWritten):
            write(logs, 3, episode=28)
    write(logs, 5, episode=28)
    span.end({"complete": False})
    content = read(path)
    check(content, 3)
    assert (content.header.facts["complete"], content.dropped) == (True, 0)
    check(read(logs.path_of(trajectory_prefix(INFIX, 28))), 5)


def test_a_full_disk_costs_no_step_that_was_recorded(path: Path) -> None:
    """The step that finds no room is refused; with room again all goes on."""
    logs = SpanLogs(path.parent, INFIX, numbers=itertools.count(), tail_bytes=8 * ROW)
    span = write(logs, 3)
    with file_size_limit(6000):
        with pytest.raises(FileNotWritten, match=r"\.log: File too large"):
            deque(write_step(span, step) for step in itertools.count(4))
        recorded = span.steps
        assert 3 < recorded < 100
        check(read(path), recorded)
        with pytest.raises(FileNotWritten, match=r"\.log: File too large"):
            logs.close()
        check(read(path), recorded)
    for step in range(recorded + 1, recorded + 9):
        write_step(span, step)
    span.end({"complete": True})
    logs.close()
    check(read(path), recorded + 8)


def test_a_log_that_could_be_closed_but_for_its_last_line_takes_no_row(
    path: Path,
) -> None:
    """It has no tail any more: the next recording gets a log of its own."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 3).end({"complete": True})
    spans, *_ = files_of(path.parent)
    with file_size_limit(spans.stat().st_size), pytest.raises(FileNotWritten):
        logs.close()
    check(read(path), 3)
    write(logs, 5, episode=28)
    check(read(path), 3)
    check(read(logs.path_of(trajectory_prefix(INFIX, 28))), 5)
    assert len(list(list_paths(path.parent))) == 2
    assert read_list(spans).is_closed


# --- logs and their lists ------------------------------------------------------------


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
def test_rows_of_another_kind_get_another_log(
    tmp_path: Path, other: dict[str, Any]
) -> None:
    """As after a change of the model, also where the size is the same."""
    logs = new_logs(tmp_path, INFIX)
    write(logs, 3)
    header = dataclasses.replace(HEADER, **other)
    span = logs.begin(trajectory_prefix(INFIX, 28), header)
    add_row(span, 0)
    first, second = list_paths(tmp_path)
    assert read_list(first).is_closed
    assert read_list(second).header == header
    [one, two] = recordings_in_flight(tmp_path)
    check(read(one.path), 3)
    assert read(two.path).header == header


def test_a_long_log_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It can be removed when its recordings are files; textures count as rows do."""
    monkeypatch.setattr(span_writer, "_LONG", 10 * ROW)
    logs = new_logs(tmp_path, INFIX)
    for episode in range(4):
        write(logs, 5, episode=episode)
    texture = ModelChange(step=6, fields={"t": np.zeros(2 * ROW)})
    write(logs, 0, episode=4).add_change(texture)
    write(logs, 5, episode=5)
    lengths = [len(read_list(p).recordings) for p in list_paths(tmp_path)]
    assert lengths == [2, 2, 1, 1]
    for each in recordings_in_flight(tmp_path):
        check(read(each.path), 0 if each.name.endswith("4") else 5)


def test_what_may_be_deleted_alone_has_a_log_of_its_own(tmp_path: Path) -> None:
    """Before it and behind it others share theirs."""
    logs = new_logs(tmp_path, INFIX)
    for episode in range(6):
        name = trajectory_prefix(INFIX, episode)
        span = logs.begin(name, HEADER, alone=episode in (2, 3))
        write_step(span, 0)
    lists = [list(read_list(p).recordings) for p in list_paths(tmp_path)]
    numbers = [[int(name[-6:]) for name in names] for names in lists]
    assert numbers == [[0, 1], [2], [3], [4, 5]]


def test_the_same_name_begun_again_is_the_newer_one(path: Path) -> None:
    """In the same log or in another; the rows of the older one are nobody's."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 9)
    write(logs, 3, again=1)
    assert read(path).header.facts["again"] == 1
    check(read(path), 3)
    logs.close()
    write(logs, 5, again=2)
    assert read(path).header.facts["again"] == 2
    check(read(path), 5)


@pytest.fixture
def monitor_lock(tmp_path: Path) -> Iterator[Lock]:
    """The lock of an open monitor."""
    lock = Lock(tmp_path / lock_name(INFIX), "")
    yield lock
    lock.release()


def test_a_list_of_which_nothing_is_needed_is_removed(tmp_path: Path) -> None:
    """With all of its files, when the last of its recordings is dropped or a file."""
    logs = new_logs(tmp_path, INFIX)
    span = write(logs, 3, episode=0)
    span.add_change(ModelChange(step=4, fields={"a": np.ones(1)}))
    paths = [logs.path_of(trajectory_prefix(INFIX, episode)) for episode in range(3)]
    for episode in (1, 2):
        write(logs, 3, episode=episode)
    logs.close()
    drop_recording(paths[1])
    drop_recording(paths[1])
    paths[0].write_bytes(b"a file")
    remove_if_done(files_of(tmp_path)[0])
    assert [each.path for each in recordings_in_flight(tmp_path)] == paths[2:]
    assert not is_in_flight(paths[0])
    assert not is_in_flight(paths[1])
    assert is_in_flight(paths[2])
    check(read(paths[2]), 3)
    drop_recording(paths[2])
    assert list(tmp_path.iterdir()) == paths[:1]


def test_a_list_that_an_open_monitor_writes_is_not_removed(
    path: Path, monitor_lock: Lock
) -> None:
    """Its next recording goes there; where the monitor was killed it is removed."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 3)
    drop_recording(path)
    write(logs, 5, episode=28)
    drop_recording(path.with_name(f"{trajectory_prefix(INFIX, 28)}.h5"))
    spans, *_ = files_of(path.parent)
    remove_if_done(spans)
    assert spans.exists()
    logs.release()
    monitor_lock.release()
    remove_if_done(spans)
    assert list(path.parent.iterdir()) == []


def test_a_list_whose_monitor_ends_while_it_is_looked_at_is_not_removed(
    path: Path, monitor_lock: Lock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it records to the very end is needed."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 3).drop()
    spans, *_ = files_of(path.parent)

    def end_late(reader: Callable[[Path], Any], name: Path) -> Any:
        monkeypatch.undo()
        # What another process has found is what there was.
        found = copy.deepcopy(reader(name))
        write(logs, 5, episode=28).end({"complete": True})
        logs.close()
        monitor_lock.release()
        return found

    for name in ("read_list", "_is_open"):
        real = getattr(in_flight, name)
        monkeypatch.setattr(in_flight, name, functools.partial(end_late, real))
    remove_if_done(spans)
    check(read(logs.path_of(trajectory_prefix(INFIX, 28))), 5)


def test_whoever_finds_a_log_half_removed_has_an_error(path: Path) -> None:
    """And no recording without its last rows, or without its changes of the model."""
    sound = path.parent / "sound"
    sound.mkdir()
    span = write(small_logs(sound), 5)
    span.add_change(ModelChange(step=6, fields={"a": np.ones(1)}))
    write_step(span, 6)
    real = Path.unlink
    for count in range(4):
        directory = Path(shutil.copytree(sound, path.parent / str(count)))
        left = iter(range(count))

        def unlink(file: Path, missing_ok: bool = False, left: Any = left) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            real(file, missing_ok=missing_ok)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Path, "unlink", unlink)
            with pytest.raises(KeyboardInterrupt):
                in_flight.remove_list(files_of(directory)[0])
        if count == 0:
            check(read(directory / path.name), 6)
            continue
        with pytest.raises(UnreadableFile, match=r"\.log: No such file"):
            read(directory / path.name)


def test_a_list_that_is_removed_meanwhile_is_passed_over(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever looks for another recording finds it."""
    logs = new_logs(path.parent, INFIX)
    write(logs, 3, episode=5)
    logs.close()
    write(logs, 5)
    first, _ = list_paths(path.parent)
    monkeypatch.setattr(in_flight, "list_paths", lambda *_: iter([first, files[1]]))
    files = list(list_paths(path.parent))
    in_flight.remove_list(first)
    check(read(path), 5)


def test_a_forked_child_does_not_write_into_its_parents_log(path: Path) -> None:
    """It lets go of it, and makes a monitor of its own; the parent goes on."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    before = [file.read_bytes() for file in sorted(path.parent.iterdir())]

    def child(_: Callable[[], object]) -> None:
        logs.release()
        logs.close()
        own = new_logs(path.parent, Infix(0, "2"))
        write_step(own.begin(trajectory_prefix(Infix(0, "2"), 0), HEADER), 0)
        own.close()
        os._exit(0)

    assert forked(child) == (0, 0)
    files = sorted(p for p in path.parent.iterdir() if ".0.1." in p.name)
    assert [file.read_bytes() for file in files] == before
    write_step(span, 4)
    logs.close()
    check(read(path), 4)


def test_a_log_that_changes_while_it_is_read_is_an_error(path: Path) -> None:
    """Never rows of something else."""
    logs = small_logs(path.parent)
    write(logs, 30)
    with SpanReader(path) as living:
        logs.close()
        _, log, *_ = files_of(path.parent)
        with SpanReader(path) as reader:
            os.truncate(log, 5 * ROW)
            for one in (reader, living):
                with pytest.raises(UnreadableFile, match=r"\.log: its "):
                    one.states(0, 31)
            log.write_bytes(bytes(100 * ROW))
            with pytest.raises(UnreadableFile, match="changed while it was read"):
                reader.snapshots(0, 4)


# --- files of another making ---------------------------------------------------------


def put(path: Path, header: str, *lines: str, log: bytes = b"") -> None:
    """Put a list of somebody else's there."""
    spans = path.with_name("openaigym.states.0.1.000000.spans")
    begin = f'{{"begin": "{path.stem}", "row": 0, "look": 0, "facts": {{}}}}'
    spans.write_text("\n".join([header, *(lines or [begin]), ""]))
    spans.with_suffix(".log").write_bytes(log)


ROWS = '"state": [], "snapshot": [], "action": null, "observation": null'
ACTION = '"state": [], "snapshot": [], "observation": null, "action": '


def head(rows: str = ROWS, facts: str = "{}", version: str = "1") -> str:
    return (
        f'{{"format": "mjrec spans", "version": {version}, '
        f'"rows": {{{rows}}}, "facts": {facts}}}'
    )


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("", "it is not whole JSON"),
        ("{" * 100_000, "JSON"),
        ("[]", "an object belongs there, not a list"),
        ("{}", "it is no list of spans"),
        (head(version="0"), "no format version 0"),
        (head(facts="1"), "'facts' is wrong"),
        (head('"state": [["a"]]'), "its name and its length"),
        (head('"state": [["a", -1]]'), "cannot be a number"),
        (head('"state": [["a/b", 1]]'), "cannot name an array"),
        (head('"snapshot": [], "state": [["a", 1], ["a", 1]]'), "the same name"),
        (head(f'{ACTION}{{"dtype": "|O", "shape": []}}'), r"'\|O' is no dtype"),
        (head(f'{ACTION}{{"dtype": "<f8", "shape": [4294967296, 1]}}'), "C int"),
    ],
)
def test_a_hostile_header_is_refused(path: Path, header: str, reason: str) -> None:
    """Each is one clear error, as often as it is read."""
    put(path, header)
    for _ in range(2):
        with pytest.raises(UnreadableFile, match=reason) as error:
            read(path)
        assert error.value.path.suffix == ".spans"
    assert recordings_in_flight(path.parent) == []


def test_a_newer_format_is_refused_with_the_way_out(path: Path) -> None:
    """Nothing of it is guessed at, and nobody removes it."""
    put(path, head(version="12"))
    for _ in range(4):
        with pytest.raises(
            UnreadableFile,
            match=r"newer mjrec, in format version 12.* to 1: update mjrec",
        ):
            read(path)
        spans, *_ = files_of(path.parent)
        remove_if_done(spans)
        assert spans.exists()


def test_a_list_cut_within_its_first_line_is_one_of_nothing(path: Path) -> None:
    """Its writer was killed before anything could be recorded."""
    write(new_logs(path.parent, INFIX), 3)
    spans, *_ = files_of(path.parent)
    for size in (0, 1, 100):
        spans.write_bytes(spans.read_bytes()[:size])
        assert recordings_in_flight(path.parent) == []
        with pytest.raises(UnreadableFile, match="no such file, and no log of it"):
            read(path)


@pytest.mark.parametrize(
    "name",
    [
        *("../x", "/etc/passwd", "a/b", "..", ".", "", "a\\u0000b", "\\ud800", "x"),
        trajectory_prefix(Infix(0, "2"), 27),
        f"../{NAME}",
        f"{NAME}.h5",
        clip_part_name(Infix(1, "1"), 0, 0),
        trajectory_prefix(INFIX, 27) + "0" * 300,
    ],
)
def test_only_names_of_the_monitor_are_believed(path: Path, name: str) -> None:
    """No path leads out of the directory, or to another monitor's files."""
    begin = f'{{"begin": "{name}", "row": 0, "look": 0, "facts": {{}}}}'
    put(path, head(), begin, f'{{"end": "{name}", "row": 5, "facts": {{}}}}')
    assert recordings_in_flight(path.parent) == []
    assert not is_in_flight(path)
    remove_if_done(files_of(path.parent)[0])


@pytest.mark.parametrize(
    "line",
    [
        *("", "[]", "5", "{", '{"end": "other"}', '{"begin": 5}', '{"end": null}'),
        *('{"note": "x", "facts": 5}', '{"drop": []}', '{"closed": 1}', "\\x00"),
        '{"a": 1, "a": 2}',
    ],
)
def test_a_line_that_says_nothing_is_passed_over(path: Path, line: str) -> None:
    """What stands behind it counts."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, 3)
    spans, *_ = files_of(path.parent)
    with spans.open("a") as file:
        file.write(f"{line}\n")
    span.end({"complete": True})
    content = read(path)
    check(content, 3)
    assert content.header.facts["complete"]
    assert not read_list(spans).is_closed


def change_with(header: str, values: bytes = b"", *, step: int = 0) -> bytes:
    """Return a change of a model whose record has a header of somebody's own."""
    start = struct.pack("<q", step) + b"\x93NUMPY\1\0"
    return start + struct.pack("<H", len(header)) + header.encode() + values


RECORD = "{{'descr': [('a', {})], 'fortran_order': False, 'shape': {}}}"


@pytest.mark.parametrize(
    "payload",
    [
        b"x",
        change_with(RECORD.format("'<f8'", "()"), bytes(8), step=-1),
        change_with(RECORD.format("'<f8'", "()"), bytes(9)),
        change_with(RECORD.format("'<f8'", "(2,)"), bytes(16)),
        change_with(RECORD.format("'|O'", "()"), bytes(8)),
        change_with(RECORD.format("'<f8', (10000000,)", "()")),
        change_with(RECORD.format("'<f8', (1 << 62,)", "()")),
        change_with("[" * 60_000),
        change_with("__import__('os')"),
    ],
)
def test_a_hostile_model_change_is_refused(path: Path, payload: bytes) -> None:
    """Its header is believed only where it fits what is there."""
    write(new_logs(path.parent, INFIX), 0)
    *_, looks = files_of(path.parent)
    looks.write_bytes(LOOK_PREFIX.pack(0, len(payload)) + payload)
    with pytest.raises(UnreadableFile, match="change of the model") as error:
        read(path)
    assert error.value.path == looks


# --- what was read before is kept ----------------------------------------------------


@pytest.mark.parametrize("more", [-1, 0, 1])
def test_a_list_by_the_name_of_one_that_was_removed_is_another(
    tmp_path: Path, more: int
) -> None:
    """As where `force` empties a directory; by the same inode, shorter or longer."""
    found = []
    for number in range(4):
        logs = new_logs(tmp_path, INFIX)
        header = dataclasses.replace(HEADER, facts={"start_time": number})
        for episode in range(4 + more * number):
            logs.begin(trajectory_prefix(INFIX, number + 10 * episode), header)
        in_flight = recordings_in_flight(tmp_path)
        names = [int(each.name[-2:]) for each in in_flight]
        found.append((names, in_flight[0].facts["start_time"]))
        logs.release()
        for file in files_of(tmp_path):
            file.unlink(missing_ok=True)
    assert found == [
        ([k + 10 * episode for episode in range(4 + more * k)], k) for k in range(4)
    ]


def test_a_line_is_added_behind_what_others_add(path: Path) -> None:
    """Half a line on a full disk is taken back only where nothing follows it."""
    write(new_logs(path.parent, INFIX), 3)
    spans, *_ = files_of(path.parent)
    real = os.write

    def write_half(descriptor: int, data: bytes) -> int:
        os.write = real
        count = os.write(descriptor, data[:20])
        append_line(spans, {"note": NAME, "facts": {"other": 1}})
        return count

    os.write = write_half
    with pytest.raises(FileNotWritten):
        add_facts(path, {"mine": 1})
    facts = read(path).header.facts
    assert (facts.get("other"), facts.get("mine")) == (1, None)

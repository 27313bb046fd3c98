# SPDX-License-Identifier: Apache-2.0
"""The journal keeps every completed episode, whatever happens to the process."""

from __future__ import annotations

import dataclasses
import itertools
import math
import resource
import signal
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import pytest

from mjrec.errors import ClosedError, UnreadableFile
from mjrec.formats.journal import JournalEntry, JournalWriter, read_journal

ENTRY = JournalEntry(
    episode_id=3,
    length=200,
    reward=1.5,
    type="e",
    start_time=1790000000.25,
    end_time=1790000001.5,
    seed=7,
    options={"x": [1, 2]},
    terminated=False,
    truncated=True,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.episodes.0.1.jsonl"


def write(path: Path, *entries: JournalEntry) -> None:
    writer = JournalWriter(path)
    for entry in entries:
        writer.append(entry)
    writer.close()


def test_entries_come_back_as_they_were(path: Path) -> None:
    """What is read is what was written, in order."""
    other = dataclasses.replace(ENTRY, episode_id=4, seed=None, options=None)
    write(path, ENTRY, other)
    assert list(read_journal(path)) == [ENTRY, other]


@pytest.mark.parametrize("reward", [math.inf, -math.inf, math.nan])
def test_rewards_that_json_has_no_number_for_come_back(
    path: Path, reward: float
) -> None:
    """NaN and infinity survive, in a file that is JSON all the same."""
    write(path, dataclasses.replace(ENTRY, reward=reward))
    assert "NaN" not in path.read_text()
    assert "Infinity" not in path.read_text()
    (entry,) = read_journal(path)
    assert entry.reward == pytest.approx(reward, nan_ok=True)


def test_no_episode_leaves_no_file(path: Path) -> None:
    """The file appears with the first episode."""
    writer = JournalWriter(path)
    writer.close()
    assert not path.exists()


def test_an_entry_is_in_the_file_when_append_returns(path: Path) -> None:
    """Nothing waits in a buffer of the process."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    assert list(read_journal(path)) == [ENTRY]
    writer.close()


def test_close_is_idempotent_and_final(path: Path) -> None:
    """A second close does nothing; a later append is an error."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    writer.close()
    writer.close()
    with pytest.raises(ClosedError, match="jsonl"):
        writer.append(ENTRY)


def test_options_of_any_type_do_not_stop_a_run(path: Path) -> None:
    """An option that JSON cannot hold is written as its repr."""
    lock = threading.Lock()
    write(path, dataclasses.replace(ENTRY, options={"lock": lock}))
    (entry,) = read_journal(path)
    assert "lock" in entry.options["lock"]["repr"]


@pytest.mark.parametrize("kept", [1, 40, -2])
def test_a_torn_last_line_is_left_out(
    path: Path, kept: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Wherever the last line was cut, the ones before it are read."""
    write(path, ENTRY, ENTRY)
    first, second = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + second[:kept])
    assert list(read_journal(path)) == [ENTRY]
    assert "line 2" in caplog.text


def test_a_last_line_that_lacks_only_its_end_counts(path: Path) -> None:
    """An episode that is wholly there is not thrown away."""
    write(path, ENTRY)
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    assert list(read_journal(path)) == [ENTRY]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (b"\0\0\0\n", "line 2"),
        (b"{}\n", "episode_id"),
        (b"[1]\n", "an object belongs there"),
        (b'{"episode_id": true}\n', "a whole number belongs there"),
        (b'{"episode_id": "1"}\n', "a whole number belongs there, not a text"),
        (b"[" * 100_000 + b"\n", "nested too deeply"),
        (b"\xff\n", "line 2"),
    ],
)
def test_a_damaged_line_is_named(path: Path, damage: bytes, reason: str) -> None:
    """Damage before the end is an error that says where and what."""
    write(path, ENTRY)
    line = path.read_bytes()
    path.write_bytes(line + damage + line)
    with pytest.raises(UnreadableFile, match=reason) as caught:
        list(read_journal(path))
    assert "line 2" in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_number_too_large_for_a_float_is_damage(path: Path) -> None:
    """No other exception comes out of a hostile file."""
    write(path, ENTRY)
    path.write_text(path.read_text().replace("1.5,", "1" + "0" * 400 + ",", 1))
    with pytest.raises(UnreadableFile, match="reward"):
        list(read_journal(path))


def test_a_missing_journal_is_an_error(path: Path) -> None:
    """There is one kind of error for what cannot be read."""
    with pytest.raises(UnreadableFile, match="No such file"):
        list(read_journal(path))


def test_reading_streams(path: Path) -> None:
    """A journal far larger than the memory allowed is read."""
    entry = dataclasses.replace(ENTRY, options="x" * 1000)
    write(path, *itertools.repeat(entry, 5000))
    tracemalloc.start()
    count = sum(1 for _ in read_journal(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 5000
    assert peak < path.stat().st_size / 10


def test_a_killed_writer_leaves_whole_lines(path: Path) -> None:
    """After SIGKILL every episode that was appended is there."""
    code = (
        "import os, pathlib, sys, mjrec.formats.journal as j\n"
        "w = j.JournalWriter(pathlib.Path(sys.argv[1]))\n"
        "for i in range(5):\n"
        "    w.append(j.JournalEntry(i, 1, 1.0, 't', 0.0, 1.0, 0, None, True, False))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    child = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert child.returncode == -signal.SIGKILL
    assert [entry.episode_id for entry in read_journal(path)] == [0, 1, 2, 3, 4]


def test_a_full_disk_leaves_whole_lines(path: Path) -> None:
    """A line that does not fit is taken back and reported."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    size = path.stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # As on a full disk, the first part of the line is written, and then no more.
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, hard))
    try:
        with pytest.raises(OSError, match="space"):
            writer.append(ENTRY)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)
    writer.append(ENTRY)
    writer.close()
    assert list(read_journal(path)) == [ENTRY, ENTRY]


def test_an_endless_line_does_not_fill_the_memory(path: Path) -> None:
    """A hostile file is given up on, not read whole."""
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(UnreadableFile, match="too long"):
        list(read_journal(path))

# SPDX-License-Identifier: Apache-2.0
"""The journal keeps every completed episode, whatever happens to the process."""

from __future__ import annotations

import dataclasses
import math
import random
import re
import signal
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from full_disk import file_size_limit

from mjrec.errors import ClosedError, UnreadableFile
from mjrec.formats import journal
from mjrec.formats.journal import (
    JournalEntry,
    JournalReader,
    JournalWriter,
    count_lines,
    read_journal,
    run_facts,
)

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
NEXT = dataclasses.replace(ENTRY, episode_id=4, seed=None, options=None)
ENV_INFO = {"gym_version": "mjrec-1", "env_id": "Hopper-v5"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.episodes.0.1.jsonl"


def write(path: Path, *entries: JournalEntry) -> None:
    writer = JournalWriter(path)
    for entry in entries:
        writer.append(entry)
    writer.close()


def test_success_is_written_and_older_lines_say_nothing_of_it(path: Path) -> None:
    """What the environment did not say is told apart from what nobody wrote down."""
    write(path, dataclasses.replace(ENTRY, success=None))
    write(path, dataclasses.replace(NEXT, success=True))
    write(path, dataclasses.replace(NEXT, episode_id=5))
    assert [e.success for e in read_journal(path)] == [None, True, journal.UNKNOWN]
    assert b"success" not in path.read_bytes().splitlines()[2]


def test_entries_come_back_as_they_were(path: Path) -> None:
    """What is read is what was written, in order."""
    write(path, ENTRY, NEXT)
    assert list(read_journal(path)) == [ENTRY, NEXT]


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


def test_the_first_line_says_what_is_recorded(path: Path) -> None:
    """Once a journal, also where one is written on; readers need no episode for it."""
    writer = JournalWriter(path, run={"env_info": ENV_INFO})
    writer.append(ENTRY)
    writer.close()
    assert run_facts(path) == {"env_info": ENV_INFO}
    writer = JournalWriter(path, run={"env_info": {}})
    writer.append(NEXT)
    writer.close()
    assert list(read_journal(path)) == [ENTRY, NEXT]
    assert path.read_text().count('"run"') == 1


def test_events_are_told_and_are_no_damage(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Between episodes, in their order; what is no event is left out and counted."""
    writer = JournalWriter(path, run={})
    writer.note("cut", {"episode_id": 2})
    writer.append(ENTRY)
    writer.note("fault", {"what": "video"})
    writer.close()
    with path.open("a") as file:
        file.write('{"party": {}}\n')
    told: list[Any] = []
    reader = JournalReader(path, on_event=lambda *event: told.append(event))
    assert list(reader) == [ENTRY]
    assert told == [
        ("run", {}),
        ("cut", {"episode_id": 2}),
        ("fault", {"what": "video"}),
    ]
    assert reader.dropped == 1


def test_writing_on_after_a_torn_line(path: Path) -> None:
    """The torn one costs nothing but itself."""
    write(path, ENTRY, NEXT)
    path.write_bytes(path.read_bytes()[:-20])
    later = dataclasses.replace(NEXT, episode_id=NEXT.episode_id + 1)
    writer = JournalWriter(path)
    writer.append(later)
    writer.close()
    assert list(read_journal(path)) == [ENTRY, later]


def test_a_last_line_cut_anywhere_is_left_out(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At each byte: the episodes before it are read, and one warning says the rest."""
    write(path, ENTRY, NEXT)
    first, second = path.read_bytes().splitlines(keepends=True)
    for kept in range(1, len(second) - 1):
        path.write_bytes(first + second[:kept])
        caplog.clear()
        assert list(read_journal(path)) == [ENTRY]
        (record,) = caplog.records
        assert f"{path}: 1 line left out: line 2" in record.getMessage()
        assert "cut off" in record.getMessage()
    assert "line 2 (episode 4)" in caplog.text


def test_the_number_of_a_torn_line_is_still_known(path: Path) -> None:
    """So that the next run does not use it again."""
    write(path, ENTRY, NEXT)
    path.write_bytes(path.read_bytes()[:-20])
    reader = JournalReader(path)
    assert list(reader) == [ENTRY]
    assert (reader.count, reader.dropped, reader.last_episode_id) == (1, 1, 4)


def test_a_last_line_that_lacks_only_its_end_counts(path: Path) -> None:
    """An episode that is wholly there is not thrown away."""
    write(path, ENTRY)
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    assert list(read_journal(path)) == [ENTRY]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (b"\0\0\0\n", "not whole JSON"),
        (b"{}\n", "no 'episode_id'"),
        (b"[1]\n", "an object belongs there"),
        (b"\n", "not whole JSON"),
        (b'{"episode_id": true}\n', "a whole number belongs there"),
        (b'{"episode_id": "1"}\n', "a whole number belongs there, not a text"),
        (b'{"episode_id": -1}\n', "negative"),
        (b'{"episode_id": 1e99}\n', "larger than any count"),
        (b'{"episode_id": ' + b"9" * 9999 + b"}\n", "not whole JSON"),
        (b"[" * 100_000 + b"\n", "nested too deeply"),
        (b"\xff\n", "not UTF-8"),
    ],
)
def test_damage_in_the_middle_costs_one_line(
    path: Path, damage: bytes, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The episodes before and after it are read; the warning says where and what."""
    write(path, ENTRY, NEXT)
    first, second = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + damage + second)
    assert list(read_journal(path)) == [ENTRY, NEXT]
    (record,) = caplog.records
    assert f"{path}: 1 line left out: line 2" in record.getMessage()
    assert reason in record.getMessage()


@pytest.mark.parametrize("key", ["reward", "end_time", "length"])
def test_a_number_too_large_is_damage(path: Path, key: str) -> None:
    """No exception comes out of a hostile file."""
    write(path, ENTRY, NEXT)
    text = re.sub(
        f'"{key}": [0-9.]+', f'"{key}": 1{"0" * 400}', path.read_text(), count=1
    )
    path.write_text(text)
    assert list(read_journal(path)) == [NEXT]


def test_an_episode_counts_once(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of two lines with one number the first is read, in any order of numbers."""
    late = dataclasses.replace(ENTRY, episode_id=10**14)
    again = dataclasses.replace(ENTRY, reward=9.0)
    write(path, late, ENTRY, NEXT, again, late)
    assert list(read_journal(path)) == [late, ENTRY, NEXT]
    assert "2 lines left out: first line 4 (episode 3)" in caplog.text


def test_what_is_no_journal_is_given_up_on(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """After a thousand damaged lines nobody expects an episode."""
    write(path, ENTRY)
    line = path.read_bytes()
    path.write_bytes(b"\n" * 999 + line)
    assert list(read_journal(path)) == [ENTRY]
    path.write_bytes(b"\n" * 1000 + line)
    assert list(read_journal(path)) == []
    assert "1000 lines and all that follows left out" in caplog.text


def test_a_garbled_journal_never_stops_a_reader(path: Path) -> None:
    """Bytes changed, taken out and put in at random: no error, no episode invented."""
    entries = [dataclasses.replace(ENTRY, episode_id=i, seed=i) for i in range(20)]
    write(path, *entries)
    whole = path.read_bytes()
    dice = random.Random(7)
    for _ in range(500):
        garbled = bytearray(whole)
        for _ in range(dice.randrange(1, 4)):
            begin = dice.randrange(len(garbled))
            end = begin + dice.choice([0, 1, 1, 5, 300])
            # No digits: a number changed into another is nobody's to find out.
            garbled[begin:end] = bytes(dice.choices(b"{}[],:x\n\0\xff", k=3))
        path.write_bytes(garbled)
        found = [entry.episode_id for entry in read_journal(path)]
        assert len(found) >= len(entries) - 12
        assert len(set(found)) == len(found)
        assert count_lines(path) >= len(found)


def test_a_missing_journal_is_an_error(path: Path) -> None:
    """There is one kind of error for what cannot be read."""
    with pytest.raises(UnreadableFile, match="No such file"):
        list(read_journal(path))


def test_a_disk_that_fails_while_it_is_read_is_an_error(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is one kind of error for that too."""
    # A file that can be opened, and of which no byte can be read.
    memory = Path("/proc/self/mem")
    monkeypatch.setattr(journal, "open_regular", lambda _: memory.open("rb"))
    for read in (count_lines, lambda path: list(read_journal(path))):
        with pytest.raises(UnreadableFile, match="Input/output error"):
            read(path)


def test_reading_streams(path: Path) -> None:
    """A journal far larger than the memory allowed is read."""
    entry = dataclasses.replace(ENTRY, options="x" * 1000)
    write(path, *(dataclasses.replace(entry, episode_id=i) for i in range(5000)))
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
    # As on a full disk, the first part of the line is written, and then no more.
    with file_size_limit(size + 10), pytest.raises(OSError, match="space"):
        writer.append(NEXT)
    writer.append(NEXT)
    writer.close()
    assert list(read_journal(path)) == [ENTRY, NEXT]


def test_half_a_line_that_could_not_be_taken_back_is_taken_back_later(
    path: Path,
) -> None:
    """Where Ctrl-C came between the two, the next episode is unharmed."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    with path.open("ab") as file:
        file.write(b'{"episode_id": 4, "le')
    writer.append(NEXT)
    writer.close()
    assert list(read_journal(path)) == [ENTRY, NEXT]


def test_options_without_end_do_not_make_a_line_without_end(path: Path) -> None:
    """They are cut off, so that every line that is written can be read."""
    write(path, dataclasses.replace(ENTRY, options="x" * (1 << 24)))
    (entry,) = read_journal(path)
    assert entry.options["repr"].startswith("'xxx")
    assert path.stat().st_size < 2000


def test_an_endless_line_does_not_fill_the_memory(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A hostile file is given up on, not read whole; what is before it is read."""
    write(path, ENTRY)
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    assert list(read_journal(path)) == [ENTRY]
    assert "1 line and all that follows left out: line 2" in caplog.text
    assert "too long" in caplog.text
    assert count_lines(path) == 1


def test_a_journal_that_was_removed_is_noticed(path: Path) -> None:
    """What is written into it is nowhere; the entry after that begins another."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    path.unlink()
    with pytest.raises(FileNotFoundError, match="removed while it was written"):
        writer.append(ENTRY)
    assert not path.exists()
    writer.append(ENTRY)
    writer.close()
    assert list(read_journal(path)) == [ENTRY]

# SPDX-License-Identifier: Apache-2.0
"""The journal keeps every completed episode."""

import json
import math
import re

import pytest
from full_disk import file_size_limit
from result_files import entry, write_journal

from mjrec.errors import ClosedError, FileNotWritten
from mjrec.formats.journal import JournalWriter, read_journal

INFIX = "0.1"
FACTS = {"type": "e", "options": {"x": [1, 2]}, "chosen": True, "recording": "live"}
ENTRY, NEXT = entry(3, **FACTS), entry(4, **{**FACTS, "options": None, "seed": None})


@pytest.fixture
def path(tmp_path):
    return tmp_path / f"openaigym.episodes.{INFIX}.jsonl"


def write(path, *entries):
    write_journal(path.parent, INFIX, *entries)


def read(path):
    return list(read_journal(path, warns=True))


@pytest.mark.parametrize(
    "facts",
    [
        {"success": True, "chosen": False, "recording": None},
        *({"reward": reward} for reward in (math.inf, -math.inf, math.nan)),
    ],
)
def test_entries_are_read_back(path, facts):
    writer, first = JournalWriter(path), entry(3, **{**FACTS, **facts})
    assert not path.exists()
    writer.append(first)
    assert repr(read(path)) == repr([first])
    writer.append(NEXT)
    writer.close()
    with pytest.raises(ClosedError, match="jsonl"):
        writer.append(NEXT)
    # NaN does not equal itself, but its text does.
    assert repr(read(path)) == repr([first, NEXT])
    assert not re.search("NaN|Infinity", path.read_text())


def test_options_of_any_type_and_size_are_written(path):
    """The journal stores their `repr`, truncated to a limit."""
    write(path, entry(3, options={"lock": re}), entry(3, options="x" * (1 << 24)))
    first, second = (json.loads(line) for line in path.read_text().splitlines())
    assert "module 're'" in first["options"]["lock"]["repr"]
    assert second["options"]["repr"].startswith("'xx")
    assert path.stat().st_size < 4000


def test_cut_last_line_is_left_out(path, caplog):
    """One warning gives the episode number if known, and writing continues."""
    later = entry(5)
    write(path, ENTRY, NEXT)
    whole = path.read_bytes()
    first, second = whole.splitlines(keepends=True)
    for kept in range(1, len(second) - 1):
        path.write_bytes(first + second[:kept])
        caplog.clear()
        assert read(path) == [ENTRY]
        [warning] = caplog.messages
        assert f"{path}: skipped 1 line: line 2" in warning
        assert "cut off" in warning
    assert "line 2 (episode 4)" in warning
    numbers = []
    assert list(read_journal(path, on_damage=numbers.append)) == [ENTRY]
    assert numbers == [4]
    write(path, later)
    assert read(path) == [ENTRY, later]
    path.write_bytes(whole.rstrip(b"\n"))
    assert read(path) == [ENTRY, NEXT]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (b"\0\0\0\n", "not valid JSON"),
        (b'{"episode_id": "1"}\n', "it must be a whole number, not a string"),
        (b'{"episode_id": 1e99}\n', "too large for a count"),
        (b'{"episode_id": 1, "episode_id": 2}\n', "the key 'episode_id' twice"),
        (b'{"episode_id": NaN}\n', "'episode_id' is wrong"),
    ],
)
def test_damage_in_the_middle_costs_one_line(path, damage, reason, caplog):
    late = entry(10**14, length=10, start_time=99.5, end_time=100.0)
    write(path, late, NEXT, entry(4, reward=9.0), ENTRY, late)
    first, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + damage + b"".join(rest))
    # The first line for a number counts, and numbers may be in any order.
    assert read(path) == [late, NEXT, ENTRY]
    [warning] = caplog.messages
    assert f"{path}: skipped 3 lines: the first is line 2" in warning
    assert reason in warning


def test_reading_stops_at_a_thousand_damaged_lines(path, caplog):
    write(path, ENTRY)
    line = path.read_bytes()
    path.write_bytes(b"\n" * 999 + line)
    assert read(path) == [ENTRY]
    path.write_bytes(b"\n" * 1000 + line)
    assert read(path) == []
    assert "skipped 1000 lines and the rest of the file" in caplog.text
    path.write_bytes(line)
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    assert read(path) == [ENTRY]
    assert "skipped 1 line and the rest of the file: line 2" in caplog.text
    assert "too long" in caplog.text


def test_failed_line_is_written_before_the_next_one(path):
    writer = JournalWriter(path)
    writer.append(ENTRY)
    # A full disk accepts only the first part of the line.
    with (
        file_size_limit(path.stat().st_size + 10),
        pytest.raises(FileNotWritten, match="space"),
    ):
        writer.append(NEXT)
    assert len(path.read_bytes().splitlines()) == 1
    with path.open("ab") as file:
        file.write(b'{"episode_id": 4, "le')
    third = entry(5)
    writer.append(third)
    assert read(path) == [ENTRY, NEXT, third]
    # A removed journal is an error, and the next entry starts a new one.
    path.unlink()
    with pytest.raises(FileNotWritten, match="removed while being written"):
        writer.append(ENTRY)
    assert not path.exists()
    writer.append(NEXT)
    writer.close()
    assert read(path) == [ENTRY, NEXT]

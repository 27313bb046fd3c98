# SPDX-License-Identifier: Apache-2.0
"""The journal keeps every completed episode, whatever happens to the process."""

import dataclasses
import json
import math
import re

import pytest
from full_disk import file_size_limit

from mjrec.errors import ClosedError, FileNotWritten
from mjrec.formats.journal import JournalEntry, JournalWriter, read_journal

ENTRY = JournalEntry(
    *(3, 200, 1.5, "e", 90.25, 91.5, 7, {"x": [1, 2]}),
    terminated=False,
    truncated=True,
    success=None,
    chosen=True,
    recording="live",
)
NEXT = dataclasses.replace(ENTRY, episode_id=4, seed=None, options=None)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "openaigym.episodes.0.1.jsonl"


def write(path, *entries, **options):
    writer = JournalWriter(path, **options)
    for entry in entries:
        writer.append(entry)
    writer.close()


def changed(**facts):
    return dataclasses.replace(ENTRY, **facts)


def read(path):
    return list(read_journal(path, warns=True))


@pytest.mark.parametrize(
    "facts",
    [
        {"success": True, "chosen": False, "recording": None},
        *({"reward": reward} for reward in (math.inf, -math.inf, math.nan)),
    ],
)
def test_entries_come_back_as_they_were(path, facts):
    """Each as `append` returns, with what JSON has no number for; then it is closed."""
    writer = JournalWriter(path)
    assert not path.exists()
    writer.append(changed(**facts))
    assert repr(read(path)) == repr([changed(**facts)])
    writer.append(NEXT)
    writer.close()
    with pytest.raises(ClosedError, match="jsonl"):
        writer.append(NEXT)
    # NaN is equal to nothing; its text is.
    assert repr(read(path)) == repr([changed(**facts), NEXT])
    assert not re.search("NaN|Infinity", path.read_text())


def test_options_of_any_type_and_size_do_not_stop_a_run(path):
    """They are written as their repr, and cut off."""
    write(path, changed(options={"lock": re}), changed(options="x" * (1 << 24)))
    first, second = (json.loads(line) for line in path.read_text().splitlines())
    assert "module 're'" in first["options"]["lock"]["repr"]
    assert second["options"]["repr"].startswith("'xx")
    assert path.stat().st_size < 4000


def test_a_last_line_cut_anywhere_is_left_out(path, caplog):
    """At each byte; one warning, its number is still known, and writing goes on."""
    later = changed(episode_id=5)
    write(path, ENTRY, NEXT)
    whole = path.read_bytes()
    first, second = whole.splitlines(keepends=True)
    for kept in range(1, len(second) - 1):
        path.write_bytes(first + second[:kept])
        caplog.clear()
        assert read(path) == [ENTRY]
        [said] = caplog.messages
        assert f"{path}: skipped 1 line: line 2" in said
        assert "cut off" in said
    assert "line 2 (episode 4)" in said
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
    """The episodes before and after it are read; the warning says where and what."""
    late = changed(episode_id=10**14)
    write(path, late, NEXT, changed(reward=9.0, episode_id=4), ENTRY, late)
    first, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + damage + b"".join(rest))
    # Of two lines with one number the first is read, in any order of numbers.
    assert read(path) == [late, NEXT, ENTRY]
    [said] = caplog.messages
    assert f"{path}: skipped 3 lines: the first is line 2" in said
    assert reason in said


def test_what_is_no_journal_is_given_up_on(path, caplog):
    """After a thousand damaged lines, or one without end; memory stays small."""
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


def test_a_line_that_does_not_fit_is_taken_back(path):
    """It comes before the next one; half a line left by Ctrl-C goes then."""
    writer = JournalWriter(path)
    writer.append(ENTRY)
    # As on a full disk, the first part of the line is written, and then no more.
    with (
        file_size_limit(path.stat().st_size + 10),
        pytest.raises(FileNotWritten, match="space"),
    ):
        writer.append(NEXT)
    assert len(path.read_bytes().splitlines()) == 1
    with path.open("ab") as file:
        file.write(b'{"episode_id": 4, "le')
    third = dataclasses.replace(NEXT, episode_id=NEXT.episode_id + 1)
    writer.append(third)
    assert read(path) == [ENTRY, NEXT, third]
    # One that is removed is noticed, and the entry after that begins another.
    path.unlink()
    with pytest.raises(FileNotWritten, match="removed while being written"):
        writer.append(ENTRY)
    assert not path.exists()
    writer.append(NEXT)
    writer.close()
    assert read(path) == [ENTRY, NEXT]

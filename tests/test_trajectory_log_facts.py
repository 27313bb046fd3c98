# SPDX-License-Identifier: Apache-2.0
"""Facts that are added to a log after it was closed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from full_disk import file_size_limit

from mjrec.errors import FileNotWritten, UnreadableFile
from mjrec.formats.trajectory import StateComponent, TrajectoryHeader
from mjrec.formats.trajectory_log import TrajectoryLogWriter
from mjrec.formats.trajectory_log_facts import append_facts
from mjrec.formats.trajectory_log_reader import TrajectoryLogReader

HEADER = TrajectoryHeader(
    facts={"video": {"name": "a.mp4"}, "seed": 7},
    state=(StateComponent("time", 0, 1),),
)
STEPS = 20


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log that was closed."""
    writer = TrajectoryLogWriter(tmp_path / "a.log", HEADER)
    for step in range(STEPS + 1):
        writer.add_step(step, 1.0, False, False, [bytes([step] * 8)])
    writer.add_facts({"complete": True})
    writer.close()
    return writer.path


def facts_of(log: Path) -> dict[str, Any]:
    """Return the facts of a log that is whole."""
    with TrajectoryLogReader(log) as reader:
        assert reader.step_count == STEPS
        assert reader.dropped == 0
        return dict(reader.header.facts)


def test_newest_facts_count(log: Path) -> None:
    """Also None is a fact; the others stay."""
    append_facts(log, {"video": None, "candidate": False})
    append_facts(log, {"candidate": True})
    assert facts_of(log) == {
        "video": None,
        "seed": 7,
        "complete": True,
        "candidate": True,
    }


def test_half_a_record_at_the_end_is_cut_off(log: Path) -> None:
    """Wherever it was torn, the facts are read behind the last whole record."""
    whole = log.read_bytes()
    append_facts(log, {"late": "1" * 30})
    longer = log.read_bytes()
    for size in range(len(whole), len(longer)):
        log.write_bytes(longer[:size])
        append_facts(log, {"late": 2})
        assert facts_of(log)["late"] == 2


def test_full_disk_leaves_the_log_as_it_was(log: Path) -> None:
    """Half a record would hide what comes after it."""
    before = log.read_bytes()
    with file_size_limit(len(before) + 10), pytest.raises(FileNotWritten):
        append_facts(log, {"candidate": False})
    assert log.read_bytes() == before


def test_damage_is_not_cut_off(log: Path) -> None:
    """What stands behind it may be of use to somebody, and the error names the file."""
    content = bytearray(log.read_bytes())
    kind = content.rindex(b"fact")
    content[kind : kind + 4] = b"\0\0\0\0"
    log.write_bytes(content)
    with pytest.raises(UnreadableFile, match=r"a\.log: it is damaged"):
        append_facts(log, {"candidate": False})
    assert log.read_bytes() == content


def test_what_is_no_log_is_left_alone(tmp_path: Path) -> None:
    """Nor is anything made where nothing is."""
    other = tmp_path / "b.log"
    other.write_text("something else\n")
    with pytest.raises(UnreadableFile, match="no trajectory"):
        append_facts(other, {"candidate": False})
    assert other.read_text() == "something else\n"
    with pytest.raises(UnreadableFile):
        append_facts(tmp_path / "c.log", {"candidate": False})
    assert not (tmp_path / "c.log").exists()

# SPDX-License-Identifier: Apache-2.0
"""`environment.json`: nothing in it is another thing than the recordings say."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from packed_runs import edit_json, record_pendulum, unpacked

import mjrec
from mjrec.evidence.verification import Verdict
from mjrec.evidence.verifying.environment_file_checks import check_environment_file
from mjrec.evidence.verifying.recorded_monitors import (
    RecordedMonitor,
    recorded_monitors,
)


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The payload of a run of two monitors, the second without videos."""
    place = tmp_path_factory.mktemp("packed")
    record_pendulum(place / "run", 1, longest=3, uid="a")
    record_pendulum(
        place / "run", 1, longest=3, uid="b", resume=True, video_callable=False
    )
    archive = mjrec.pack(place / "run", place / "run.zip")
    return unpacked(archive, place / "unpacked") / "data"


@pytest.fixture(scope="module")
def monitors(packed: Path) -> list[RecordedMonitor]:
    """What is recorded."""
    return list(recorded_monitors(packed / "recordings"))


@pytest.fixture
def file(packed: Path, tmp_path: Path) -> Path:
    """A copy of the file, to be changed."""
    copy = tmp_path / "environment.json"
    copy.write_bytes((packed / "environment.json").read_bytes())
    return copy


def objections(file: Path, monitors: list[RecordedMonitor]) -> list[str]:
    checks = check_environment_file(file, monitors)
    return [f"{c.subject}: {c.reason}" for c in checks if c.verdict is Verdict.FAIL]


def test_what_was_packed_passes(file: Path, monitors: list[RecordedMonitor]) -> None:
    """Word for word, of each monitor."""
    assert len(json.loads(file.read_text())["recordings"]) == 2
    [check] = check_environment_file(file, monitors)
    assert check.verdict is Verdict.PASS


def infix(said: Any, uid: str) -> str:
    """Return a monitor's infix, whose number depends on those before it."""
    [found] = [name for name in said["recordings"] if name.endswith(f".{uid}")]
    return str(found)


def of_first(edit: Callable[[Any], object]) -> Callable[[Any], object]:
    return lambda said: edit(said["recordings"][infix(said, "a")])


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            of_first(lambda r: r["pictures"][0].update(gl_renderer="RTX 4090")),
            ".a: pictures[0].gl_renderer: it says 'RTX 4090', the recordings",
        ),
        (
            of_first(lambda r: r["pictures"].append({"gl_renderer": "RTX 4090"})),
            "pictures[1]: it says {'gl_renderer': 'RTX 4090'}, the recordings nothing",
        ),
        (of_first(lambda r: r["encoders"].clear()), "encoders[0]: it says nothing"),
        (of_first(lambda r: r.update(env_id="Ant-v5")), "env_id: it says 'Ant-v5'"),
        (
            of_first(lambda r: r["versions"].update(mujoco="9.9.9")),
            "versions.mujoco: it says '9.9.9'",
        ),
        (
            of_first(lambda r: r["surroundings"]["cpu"].update(model="Cray-1")),
            "surroundings.cpu.model: it says 'Cray-1'",
        ),
        (of_first(lambda r: r.update(score=1.0)), "score: it says 1.0"),
        (
            lambda said: said["recordings"].pop(infix(said, "b")),
            ".b: it says nothing",
        ),
        (lambda said: said.update(recordings=[7]), ".a: it says nothing"),
        (lambda said: said.update(gpu="RTX 4090"), "gpu: it says 'RTX 4090'"),
        (lambda said: said["packed_with"].update(gpu="RTX 4090"), "packed_with:"),
        (lambda said: said.update(packed_with=None), "packed_with:"),
    ],
)
def test_other_words_are_found(
    edit: Callable[[Any], object],
    says: str,
    file: Path,
    monitors: list[RecordedMonitor],
) -> None:
    """With what the recordings say."""
    edit_json(file, edit)
    found = objections(file, monitors)
    assert any(says in objection for objection in found), found


@pytest.mark.parametrize("content", [b"", b"[]", b"\xff", b'{"a": 1, "a": 2}'])
def test_file_that_is_none_is_a_failure(
    content: bytes, file: Path, monitors: list[RecordedMonitor]
) -> None:
    """And no error."""
    file.write_bytes(content)
    [objection] = objections(file, monitors)
    assert "it cannot be read" in objection

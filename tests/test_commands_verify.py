# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from packed_runs import the

import mjrec
from mjrec.commands import main


@pytest.fixture(scope="module")
def packed(
    pendulums: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A packed run of one episode."""
    return mjrec.pack(pendulums(1), tmp_path_factory.mktemp("packed") / "run.zip")


def test_honest_run_is_verified(
    packed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table for each level, and a verdict at the end."""
    assert main(["verify", str(packed), "--level", "stats"]) == 0
    said = capsys.readouterr().out
    assert "files: are all files there" in said
    assert "physics" not in said
    assert said.splitlines()[-1].startswith("Verified: ")


@pytest.mark.thorough
def test_everything_is_verified_by_default(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All four levels, and a page about it."""
    page = tmp_path / "verify.html"
    assert main(["verify", str(packed), "--report", str(page), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {check["level"] for check in said["checks"]} == {
        *("files", "stats", "physics", "pixels")
    }
    assert "<html" in page.read_text()


def test_json_has_every_check(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One object with stable fields, for scripts."""
    assert main(["verify", str(packed), "--level", "files", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said) == {"path", "level", "passed", "counts", "checks", "facts"}
    assert said["passed"] is True
    assert sum(said["counts"].values()) == len(said["checks"])
    assert set(said["checks"][0]) == {
        *("level", "verdict", "claim", "subject", "reason", "figures")
    }


def test_failure_is_shown_first_and_is_status_1(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With its reason; names cannot give orders to the terminal."""
    shutil.unpack_archive(packed, tmp_path)
    the(tmp_path, "README.md").write_text("new")
    (tmp_path / "run" / "a\x1b[31m[bold]b").write_text("")
    assert main(["verify", str(tmp_path), "--level", "files"]) == 1
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "[bold]b" in said
    assert said.index("data/README.md") < said.index(" pass ")
    assert said.splitlines()[-1].startswith("FAILED: ")


def test_what_cannot_be_checked_is_no_failure_and_no_proof(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The verdict says so."""
    shutil.unpack_archive(packed, tmp_path)
    recordings = the(tmp_path, "recordings")
    assert main(["verify", str(recordings), "--level", "files"]) == 0
    assert "not proved" in capsys.readouterr().out


def test_what_cannot_be_read_is_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And status 1."""
    path = tmp_path / "run.zip"
    path.write_bytes(b"PK\x03\x04")
    assert main(["verify", str(path)]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"mjrec: Cannot verify {path}: it is no zip file")

# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a program, and of which."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mjrec.formats import program_facts
from mjrec.formats.program_facts import remembered


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program"
    path.write_text("one")
    return path


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "mjrec" / "programs.json"


def ask(program: Path, asked: list[str], answer: str = "yes") -> str:
    """Ask as a new process does, and note where the program had to be asked."""
    program_facts._found.clear()
    return remembered(str(program), "does it work?", lambda: asked.append("") or answer)


def test_a_program_is_asked_once(program: Path, cache: Path) -> None:
    """Another process need not ask, until the file is another one."""
    asked: list[str] = []
    assert [ask(program, asked), ask(program, asked)] == ["yes", "yes"]
    assert len(asked) == 1
    # Of the same size and time of change.
    before = program.stat()
    program.write_text("two")
    os.utime(program, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert ask(program, asked, "no") == "no"
    assert len(asked) == 2


@pytest.mark.parametrize("what", ["garbage", "no place"])
def test_what_cannot_be_read_is_asked_anew(
    what: str, program: Path, cache: Path
) -> None:
    """Whatever stands in its place."""
    asked: list[str] = []
    if what == "no place":
        cache.parents[1].write_text("a file")
    else:
        ask(program, asked)
        cache.write_text("[1]")
    assert ask(program, asked, "no") == "no"

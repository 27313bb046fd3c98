# SPDX-License-Identifier: Apache-2.0
"""A lock is held exactly as long as its process lives or until it is released."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mjrec.formats.locks import Lock, is_locked

# Holds the lock at argv[1], says so, and waits for its input to end. With a second
# argument it also starts a process that outlives it.
HOLDER = """
import pathlib, subprocess, sys
from mjrec.formats.locks import Lock
lock = Lock(pathlib.Path(sys.argv[1]), "held")
if sys.argv[2:] == ["exec"]:
    subprocess.Popen(["cat"], stdout=subprocess.DEVNULL, close_fds=False)
print("held", flush=True)
sys.stdin.read()
"""
# Holds the lock, forks, and lets the child print its number and wait.
FORKER = """
import os, pathlib, sys
from mjrec.formats.locks import Lock
lock = Lock(pathlib.Path(sys.argv[1]), "held")
if os.fork() == 0:
    lock.release()
    print(os.getpid(), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / ".openaigym.0.1.lock"


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.communicate()


def start(
    processes: list[subprocess.Popen[str]], code: str, *arguments: str
) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    processes.append(process)
    return process


def test_a_lock_is_seen_until_it_is_released(path: Path) -> None:
    """Also by the process that holds it; release removes the file."""
    lock = Lock(path, "who holds it")
    assert is_locked(path)
    assert path.read_text() == "who holds it"
    lock.release()
    assert not path.exists()
    assert not is_locked(path)


def test_release_is_idempotent(path: Path) -> None:
    """A second release leaves a later monitor's lock alone."""
    first = Lock(path, "first")
    first.release()
    second = Lock(path, "second")
    first.release()
    assert is_locked(path)
    second.release()


def test_release_leaves_a_file_that_took_its_place(path: Path) -> None:
    """What somebody else put there is theirs."""
    lock = Lock(path, "first")
    path.unlink()
    path.write_text("another")
    lock.release()
    assert path.read_text() == "another"


def test_a_taken_name_is_an_error(path: Path) -> None:
    """Whether it is held or left behind, and it stays as it was."""
    lock = Lock(path, "first")
    with pytest.raises(FileExistsError):
        Lock(path, "second")
    assert is_locked(path)
    lock.release()
    path.write_text("left behind")
    with pytest.raises(FileExistsError):
        Lock(path, "second")
    assert path.read_text() == "left behind"


def test_no_file_stays_where_no_lock_can_be(tmp_path: Path) -> None:
    """A directory that is not there is an OSError."""
    with pytest.raises(FileNotFoundError):
        Lock(tmp_path / "missing" / "lock", "")


def test_a_file_that_nobody_holds_is_not_locked(path: Path) -> None:
    """Even when it names a living process: numbers come round again."""
    path.write_text(str(os.getpid()))
    assert not is_locked(path)


def test_the_lock_of_another_process_is_seen(
    path: Path, processes: list[subprocess.Popen[str]]
) -> None:
    """While it lives; after SIGKILL only the file is left."""
    holder = start(processes, HOLDER, str(path))
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    assert is_locked(path)
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert path.exists()
    assert not is_locked(path)


@pytest.mark.parametrize("left", ["exec", "fork"])
def test_a_process_left_behind_does_not_keep_the_lock(
    path: Path, left: str, processes: list[subprocess.Popen[str]]
) -> None:
    """Neither a started program nor a forked child holds it after a kill.

    The child's own `release` does not take it from the parent either.
    """
    code = FORKER if left == "fork" else HOLDER
    holder = start(processes, code, str(path), left)
    assert holder.stdout is not None
    holder.stdout.readline()
    assert is_locked(path)
    holder.kill()
    holder.wait()
    assert not is_locked(path)

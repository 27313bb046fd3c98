# SPDX-License-Identifier: Apache-2.0
"""A lock is held exactly as long as its process lives or until it is released."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from full_disk import file_size_limit

from mjrec.formats.locks import Lock, is_locked, try_lock, wait_for_lock

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
# Adds one to the number in the file at argv[2], so many times, each time under the
# lock at argv[1], which is removed and made again all the while.
COUNTER = """
import pathlib, sys
from mjrec.formats.locks import wait_for_lock
lock, number = map(pathlib.Path, sys.argv[1:3])
for _ in range(int(sys.argv[3])):
    held = wait_for_lock(lock, "")
    number.write_text(str(int(number.read_text()) + 1))
    held.release()
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


@pytest.mark.parametrize("way", ["Lock", "try_lock"])
@pytest.mark.parametrize("left", ["exec", "fork"])
def test_a_process_left_behind_does_not_keep_the_lock(
    path: Path, left: str, way: str, processes: list[subprocess.Popen[str]]
) -> None:
    """Neither a started program nor a forked child holds it after a kill.

    The child's own `release` does not take it from the parent either.
    """
    code = (FORKER if left == "fork" else HOLDER).replace("Lock", way)
    holder = start(processes, code, str(path), left)
    assert holder.stdout is not None
    holder.stdout.readline()
    assert is_locked(path)
    holder.kill()
    holder.wait()
    assert not is_locked(path)


def test_a_lock_that_somebody_holds_is_not_got(path: Path) -> None:
    """Trying tells; the file is there as long as it is held."""
    first = try_lock(path, "first")
    assert first is not None
    assert try_lock(path, "second") is None
    assert path.read_text() == "first"
    first.release()
    assert not path.exists()


def test_what_a_dead_process_left_is_taken_over(
    path: Path, processes: list[subprocess.Popen[str]]
) -> None:
    """With the new holder's content, however long the old one was."""
    holder = start(processes, HOLDER, str(path))
    assert holder.stdout is not None
    holder.stdout.readline()
    assert try_lock(path, "") is None
    holder.kill()
    holder.wait()
    lock = try_lock(path, "me")
    assert lock is not None
    assert path.read_text() == "me"
    assert is_locked(path)
    lock.release()


def test_being_looked_at_does_not_keep_a_lock_from_being_got(path: Path) -> None:
    """`is_locked` holds a left-over for a moment, which is waited for."""
    path.write_text("left behind")
    looking = path.open()
    fcntl.flock(looking, fcntl.LOCK_SH)
    threading.Timer(0.003, looking.close).start()
    lock = try_lock(path, "")
    assert lock is not None
    lock.release()


def test_one_at_a_time_has_a_lock(
    path: Path, tmp_path: Path, processes: list[subprocess.Popen[str]]
) -> None:
    """Though each removes the file that the others wait for."""
    number = tmp_path / "number"
    number.write_text("0")
    counters = [
        start(processes, COUNTER, str(path), str(number), "300") for _ in range(3)
    ]
    assert [counter.wait() for counter in counters] == [0, 0, 0]
    assert number.read_text() == "900"


@pytest.mark.parametrize("get", [try_lock, wait_for_lock])
@pytest.mark.parametrize("put", [os.symlink, os.link])
def test_no_other_file_is_taken_for_a_lock(
    put: Callable[[Path, Path], None],
    get: Callable[[Path, str], Lock | None],
    path: Path,
    tmp_path: Path,
) -> None:
    """Neither by following a link nor by another name of it: its content stays."""
    victim = tmp_path / "victim"
    victim.write_text("valuable")
    put(victim, path)
    with pytest.raises(OSError, match="no lock is"):
        get(path, "me")
    assert victim.read_text() == "valuable"
    assert not is_locked(path)


def test_no_file_is_made_through_a_link(path: Path, tmp_path: Path) -> None:
    """A link to nothing is refused as well."""
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="no lock is"):
        try_lock(path, "me")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_no_lock(make: Callable[[Path], None], path: Path) -> None:
    """Nobody waits for a pipe, and nobody can hold one."""
    make(path)
    with pytest.raises(OSError, match="no lock is"):
        try_lock(path, "me")
    assert not is_locked(path)


def test_a_full_disk_keeps_nobody_from_a_lock(tmp_path: Path) -> None:
    """Its content is for people; the lock is in the kernel."""
    path = tmp_path / ".lock"
    with file_size_limit(0):
        lock = try_lock(path, "content")
    assert lock is not None
    assert is_locked(path)
    lock.release()
    assert not path.exists()

# SPDX-License-Identifier: Apache-2.0
"""Test that a lock is held until it is released or its process dies."""

import os
import subprocess
import sys

import pytest

from mjrec import DirectoryNotWritable
from mjrec.formats.locks import Lock, is_locked, try_lock, wait_for_lock

HOLD = """
import os, pathlib, subprocess, sys
from mjrec.formats.locks import Lock, try_lock, wait_for_lock
path = pathlib.Path(sys.argv[1])
"""
WAIT = 'print("held", flush=True)\nsys.stdin.read()\n'
# These children, a program and a fork, outlive the holder of the lock.
SURVIVORS = {
    "exec": 'subprocess.Popen(["cat"], stdout=subprocess.DEVNULL, close_fds=False)\n',
    "fork": "if os.fork(): sys.stdin.read()\nlock.release()\n",
}
# Every release deletes the lock file, so each iteration creates it again.
COUNT = """
number = path.with_name("number")
for _ in range(300):
    held = wait_for_lock(path)
    number.write_text(str(int(number.read_text()) + 1))
    held.release()
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / ".openaigym.0.1.lock"


@pytest.fixture
def start(path):
    """Return a function that runs code in a process where `path` is the lock file."""
    started = []

    def run(code):
        command = [sys.executable, "-c", HOLD + code, str(path)]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_release_removes_only_its_own_file(path):
    first = Lock(path, "who holds it")
    assert is_locked(path)
    with pytest.raises(FileExistsError):
        Lock(path, "second")
    assert try_lock(path) is None
    assert path.read_text() == "who holds it"
    path.unlink()
    path.write_text("another's")
    first.release()
    first.release()
    assert path.read_text() == "another's"


@pytest.mark.parametrize("way", ["Lock", "try_lock"])
@pytest.mark.parametrize("survivor", SURVIVORS)
def test_killed_process_holds_no_lock(path, survivor, way, start):
    """Another process can take over the lock file even while a child survives."""
    call = 'Lock(path, "content")' if way == "Lock" else "try_lock(path)"
    holder = start(f"lock = {call}\n{SURVIVORS[survivor]}{WAIT}")
    assert holder.stdout.readline() == "held\n"
    assert is_locked(path)
    assert try_lock(path) is None
    holder.kill()
    holder.wait()
    assert not is_locked(path)
    content = path.read_text()
    lock = try_lock(path)
    assert is_locked(path)
    assert path.read_text() == content
    lock.release()
    assert not path.exists()


def test_lock_is_exclusive_between_processes(path, start):
    number = path.with_name("number")
    number.write_text("0")
    assert [each.wait() for each in [start(COUNT) for _ in range(3)]] == [0, 0, 0]
    assert number.read_text() == "900"


@pytest.mark.parametrize("get", [try_lock, wait_for_lock])
@pytest.mark.parametrize("put", [os.symlink, os.link, lambda _, path: os.mkfifo(path)])
def test_links_and_pipes_are_rejected_as_locks(put, get, path):
    victim = path.with_name("victim")
    victim.write_text("valuable")
    put(victim, path)
    with pytest.raises(DirectoryNotWritable, match="so it is not a lock"):
        get(path)
    assert victim.read_text() == "valuable"
    assert not is_locked(path)

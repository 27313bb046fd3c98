# SPDX-License-Identifier: Apache-2.0
"""A lock is held exactly as long as its process lives or until it is released."""

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
# A program and a forked child that outlive the process that holds the lock.
LEFT = {
    "exec": 'subprocess.Popen(["cat"], stdout=subprocess.DEVNULL, close_fds=False)\n',
    "fork": "if os.fork(): sys.stdin.read()\nlock.release()\n",
}
# Adds one under the lock, which is removed and made again all the while.
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
    """Run code in a process that has the lock's `path`."""
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


def test_a_lock_is_held_until_it_is_released(path):
    """Release removes the file, and leaves one that another has put there."""
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
@pytest.mark.parametrize("left", LEFT)
def test_a_killed_process_holds_no_lock(path, left, way, start):
    """Whatever it leaves behind; the file is taken over, with what it says."""
    call = 'Lock(path, "content")' if way == "Lock" else "try_lock(path)"
    holder = start(f"lock = {call}\n{LEFT[left]}{WAIT}")
    assert holder.stdout.readline() == "held\n"
    assert is_locked(path)
    assert try_lock(path) is None
    holder.kill()
    holder.wait()
    assert not is_locked(path)
    said = path.read_text()
    lock = try_lock(path)
    assert is_locked(path)
    assert path.read_text() == said
    lock.release()
    assert not path.exists()


def test_one_process_at_a_time_has_a_lock(path, start):
    """Though each removes the file that the others wait for."""
    number = path.with_name("number")
    number.write_text("0")
    assert [each.wait() for each in [start(COUNT) for _ in range(3)]] == [0, 0, 0]
    assert number.read_text() == "900"


@pytest.mark.parametrize("get", [try_lock, wait_for_lock])
@pytest.mark.parametrize("put", [os.symlink, os.link, lambda _, path: os.mkfifo(path)])
def test_no_other_file_is_taken_for_a_lock(put, get, path):
    """Neither through a link nor by its second name; a pipe is not waited for."""
    victim = path.with_name("victim")
    victim.write_text("valuable")
    put(victim, path)
    with pytest.raises(DirectoryNotWritable, match="so it is not a lock"):
        get(path)
    assert victim.read_text() == "valuable"
    assert not is_locked(path)

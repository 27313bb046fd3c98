# SPDX-License-Identifier: Apache-2.0
"""The CPUs of a directory are shared by all who render into it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import children
from rides import record

from mjrec import DirectoryNotWritable
from mjrec.formats.locks import Lock, try_lock
from mjrec.formats.monitor_directory import render_lock_name
from mjrec.rendering import shared_pool
from mjrec.rendering.shared_pool import SharedPool

# Takes what is free of the two CPUs of argv[1], says how many, and waits.
HOLDER = """
import pathlib, sys
from mjrec.rendering import shared_pool
shared_pool.usable_cpus = lambda: 2
shared = shared_pool.SharedPool(pathlib.Path(sys.argv[1]), workers=None)
print(shared.at_work().limit, flush=True)
sys.stdin.read()
"""


class Waited(Exception):
    """Stands for a wait without an end."""


def raise_waited(seconds: float) -> None:
    raise Waited


@pytest.fixture(autouse=True)
def two_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the machine have two CPUs."""
    monkeypatch.setattr(shared_pool, "usable_cpus", lambda: 2)


def pool_of(
    directory: Path, wait: Callable[[float], object] = raise_waited
) -> SharedPool:
    return SharedPool(directory, workers=None, wait=wait)


def hold_one(directory: Path) -> Lock:
    """Take a CPU, as somebody else does on a machine with one."""
    lock = try_lock(directory / render_lock_name(0), "1\n")
    assert lock is not None
    return lock


def test_all_that_is_free_is_taken(tmp_path: Path) -> None:
    """As many as the process may use; the first comer has them."""
    first, second = pool_of(tmp_path), pool_of(tmp_path)
    assert first.at_work().limit == 2
    with pytest.raises(Waited):
        second.at_work()


def test_a_number_of_workers_waits_for_nobody(tmp_path: Path) -> None:
    """Who asks for three gets three, and takes no CPU from others."""
    first = pool_of(tmp_path)
    first.at_work()
    assert SharedPool(tmp_path, workers=3, wait=raise_waited).at_work().limit == 3


def test_one_who_holds_some_does_not_wait_for_more(tmp_path: Path) -> None:
    """He takes them when they are free."""
    other = hold_one(tmp_path)
    pool = pool_of(tmp_path)
    assert pool.at_work().limit == 1
    other.release()
    assert pool.at_work().limit == 2


def test_one_who_has_none_waits_for_the_first(tmp_path: Path) -> None:
    """However long it takes."""
    first = pool_of(tmp_path)
    first.at_work()
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            first.rest()

    assert pool_of(tmp_path, wait).at_work().limit == 2
    assert len(waits) == 3


def test_a_wait_can_be_interrupted(tmp_path: Path) -> None:
    """It leaves nothing behind."""
    first, second = pool_of(tmp_path), pool_of(tmp_path)
    first.at_work()
    with pytest.raises(Waited):
        second.at_work()
    first.rest()
    assert second.at_work().limit == 2


def test_nothing_stays_in_the_directory(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """The files are gone when the CPUs are given back, which may be done again."""
    pool = pool_of(tmp_path)
    pool.at_work()
    assert names(tmp_path) == [f".openaigym.render.{k}.lock" for k in (0, 1)]
    pool.rest()
    pool.close()
    assert names(tmp_path) == []


def test_the_cpus_of_a_dead_process_are_free(tmp_path: Path) -> None:
    """Though its files are still there."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"2\n"
        with pytest.raises(Waited):
            pool_of(tmp_path).at_work()
        holder.kill()
    assert pool_of(tmp_path).at_work().limit == 2


def test_workers_can_be_started_before_there_is_work(tmp_path: Path) -> None:
    """As many as CPUs are free, which others may use until there is work."""
    before = children()
    pool = pool_of(tmp_path)
    pool.start()
    pool.start()
    started = children() - before
    assert len(started) == 2
    assert pool_of(tmp_path).at_work().limit == 2
    pool.close()
    assert children() == before


def test_workers_stay_while_cpus_come_and_go(tmp_path: Path) -> None:
    """Others take one between two videos; nobody starts the workers anew."""
    ride = record(tmp_path)
    before = children()
    shared = pool_of(tmp_path)
    list(shared.at_work().frames(ride.path, range(4)))
    both = children() - before
    assert len(both) == 2
    shared.rest()
    other = hold_one(tmp_path)
    alone = list(shared.at_work().frames(ride.path, range(4)))
    other.release()
    together = list(shared.at_work().frames(ride.path, range(4)))
    assert children() - before == both
    assert np.array_equal(alone, together)
    shared.close()
    assert children() == before


def test_a_directory_that_is_gone(tmp_path: Path) -> None:
    """It is one clear error."""
    with pytest.raises(DirectoryNotWritable):
        pool_of(tmp_path / "gone").at_work()

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
from mjrec.machine import usable_cpus
from mjrec.rendering import shared_pool
from mjrec.rendering.shared_pool import CpuSlots, SharedPool

# Takes what is free of the two CPUs of argv[1], says how many, and waits.
HOLDER = """
import pathlib, sys
from mjrec.rendering.shared_pool import CpuSlots
slots = CpuSlots(pathlib.Path(sys.argv[1]), total=2)
print(slots.take(int(sys.argv[2])), flush=True)
sys.stdin.read()
"""


class Waited(Exception):
    """Stands for a wait without an end."""


def raise_waited(seconds: float) -> None:
    raise Waited


def slots_of(directory: Path, total: int = 2) -> CpuSlots:
    return CpuSlots(directory, total=total, wait=raise_waited)


def test_there_are_as_many_as_the_process_may_use(tmp_path: Path) -> None:
    """Affinity and cgroup decide."""
    assert CpuSlots(tmp_path).total == usable_cpus()


def test_only_what_is_needed_is_taken(tmp_path: Path) -> None:
    """And what is free is there for others."""
    first, second = slots_of(tmp_path, 4), slots_of(tmp_path, 4)
    assert first.take(1) == 1
    assert second.take(99) == 3
    assert first.take(4) == 1


def test_one_who_holds_some_does_not_wait_for_more(tmp_path: Path) -> None:
    """He takes them when they are free."""
    first, second = slots_of(tmp_path), slots_of(tmp_path)
    first.take(1)
    assert second.take(2) == 1
    first.give_back()
    assert second.take(2) == 2


def test_one_who_has_none_waits_for_the_first(tmp_path: Path) -> None:
    """However long it takes."""
    first = slots_of(tmp_path)
    first.take(2)
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            first.give_back()

    assert CpuSlots(tmp_path, total=2, wait=wait).take(2) == 2
    assert len(waits) == 3


def test_a_wait_can_be_interrupted(tmp_path: Path) -> None:
    """It leaves nothing behind."""
    first, second = slots_of(tmp_path), slots_of(tmp_path)
    first.take(2)
    with pytest.raises(Waited):
        second.take(1)
    first.give_back()
    assert second.take(2) == 2


def test_nothing_stays_in_the_directory(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """The files are gone when the CPUs are given back, which may be done again."""
    slots = slots_of(tmp_path)
    slots.take(2)
    assert names(tmp_path) == [f".openaigym.render.{k}.lock" for k in (0, 1)]
    slots.give_back()
    slots.give_back()
    assert names(tmp_path) == []
    assert slots.held == 0


def test_the_cpus_of_a_dead_process_are_free(tmp_path: Path) -> None:
    """Though its files are still there."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path), "2"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"2\n"
        with pytest.raises(Waited):
            slots_of(tmp_path).take(1)
        holder.kill()
    assert slots_of(tmp_path).take(2) == 2


def test_workers_stay_while_cpus_come_and_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others take one between two videos; nobody starts the workers anew."""
    ride = record(tmp_path)
    monkeypatch.setattr(shared_pool, "usable_cpus", lambda: 2)
    before = children()
    shared = SharedPool(tmp_path, workers=None)
    list(shared.at_work().frames(ride.path, range(4)))
    both = children() - before
    assert len(both) == 2
    shared.rest()
    other = slots_of(tmp_path)
    other.take(1)
    alone = list(shared.at_work().frames(ride.path, range(4)))
    shared.rest()
    other.give_back()
    together = list(shared.at_work().frames(ride.path, range(4)))
    assert children() - before == both
    assert np.array_equal(alone, together)
    shared.close()
    assert children() == before


def test_a_directory_that_is_gone(tmp_path: Path) -> None:
    """It is one clear error."""
    with pytest.raises(DirectoryNotWritable):
        slots_of(tmp_path / "gone").take(1)

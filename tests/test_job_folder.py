# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import concurrent.futures
import json
import os
import shutil
import threading
import time
from pathlib import Path

import pytest

from mjrec.engines import driver_sign
from mjrec.engines.driver_sign import DriverSign, is_surely_dead
from mjrec.engines.gpu_shares import GpuShare
from mjrec.engines.hosting import HostedWork
from mjrec.engines.job_folder import HostState, JobFolder
from mjrec.engines.work import Work


def made(place: Path, payload: bytes | None = None) -> JobFolder:
    hosted = HostedWork.of(Work(entry="a:b", settings={"x": 1}), GpuShare())
    return JobFolder.make(place / "run", hosted, payload)


def names(place: Path) -> list[str]:
    return sorted(str(p.relative_to(place)) for p in place.rglob("*") if p.is_file())


@pytest.mark.parametrize("payload", [None, b"", b"large"])
def test_work_lies_there(tmp_path: Path, payload: bytes | None) -> None:
    """Its payload apart, which none is not an empty one."""
    made(tmp_path, payload)
    folder = JobFolder(tmp_path / "run")
    assert folder.work().work == Work(entry="a:b", settings={"x": 1})
    assert folder.payload() == payload


def test_a_job_goes_to_and_fro(tmp_path: Path) -> None:
    """It waits, is taken, and its answer is read once; nothing of it is left."""
    folder = made(tmp_path)
    before = names(tmp_path)
    folder.put(7, b'{"key": "a"}')
    job = folder.take("1_2-0")
    assert job is not None
    assert (job.number, job.line) == (7, b'{"key": "a"}')
    assert folder.take("other-0") is None
    [noted] = folder.taken()
    assert (noted.number, noted.host) == (7, "1_2-0")
    folder.answer(job, b"{}")
    assert folder.taken() == []
    [answer] = folder.answers()
    assert (answer.number, answer.host, answer.line) == (7, "1_2-0", b"{}")
    assert list(folder.answers()) == []
    assert names(tmp_path) == before


def test_a_job_is_taken_by_one(tmp_path: Path) -> None:
    """However many try for the same ones at the same time."""
    folder = made(tmp_path)
    for number in range(200):
        folder.put(number, b"{}")
    all_ready = threading.Barrier(8)

    def take_all(name: str) -> list[int]:
        all_ready.wait()
        found = []
        while (job := folder.take(name)) is not None:
            found.append(job.number)
        return found

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        taken = list(pool.map(take_all, [f"{n}-0" for n in range(8)]))
    assert sorted(number for each in taken for number in each) == list(range(200))


def test_a_claim_whose_answer_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over NFS: the rename was done, and asking once more says there is no file."""
    folder = made(tmp_path)
    folder.put(1, b"{}")
    rename = Path.rename

    def lose_answer(self: Path, target: Path) -> Path:
        rename(self, target)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", lose_answer)
    job = folder.take("1-0")
    assert job is not None
    assert job.number == 1


def test_what_is_being_written_is_not_there(tmp_path: Path) -> None:
    """Nor is what a process that was killed has left of it."""
    folder = made(tmp_path)
    for part in ("jobs", "done"):
        (tmp_path / "run" / part / ".000001.json.0123abcd.part").write_text('{"ke')
    assert folder.take("1-0") is None
    assert list(folder.answers()) == []


def test_what_hosts_say_of_themselves(tmp_path: Path) -> None:
    """The last that each has said."""
    folder = made(tmp_path)
    folder.note_host("1_0-0", HostState.WORKING)
    folder.note_host("1_1-0", HostState.WORKING)
    folder.note_host("1_1-0", HostState.LEAVING)
    folder.note_host("2-3", HostState.WORKING)
    folder.note_host("2-3", HostState.ENDED)
    assert folder.hosts() == {
        "1_0-0": HostState.WORKING,
        "1_1-0": HostState.LEAVING,
        "2-3": HostState.ENDED,
    }


def test_the_end(tmp_path: Path) -> None:
    """Hosts are told, also where the folder is gone."""
    folder = made(tmp_path)
    assert not folder.is_stopped
    folder.stop()
    assert folder.is_stopped
    shutil.rmtree(folder.path)
    assert folder.is_stopped
    assert folder.take("1-0") is None
    folder.stop()
    assert not folder.path.exists()


def test_a_sign_of_life(tmp_path: Path) -> None:
    """It changes as long as the driver lives, whatever that is at."""
    folder = made(tmp_path)
    sign = DriverSign(folder, "local", every_s=0.01)
    signs = set()
    deadline = time.monotonic() + 30
    while len(signs) < 3:
        assert time.monotonic() < deadline
        signs.add(folder.sign())
    sign.stop()
    last = folder.sign()
    assert json.loads(last)["pid"] == os.getpid()
    assert not is_surely_dead(last)


def test_a_dead_driver_is_known_by_its_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On its own machine, be there another process of its number; nowhere else."""
    folder = made(tmp_path)
    DriverSign(folder, "slurm", every_s=1).stop()
    sign = json.loads(folder.sign())
    assert is_surely_dead(json.dumps({**sign, "started": "1"}).encode())
    assert is_surely_dead(json.dumps({**sign, "pid": 2**30}).encode())
    monkeypatch.setattr(driver_sign, "_machine", lambda: "another")
    assert not is_surely_dead(json.dumps({**sign, "pid": 2**30}).encode())
    assert not is_surely_dead(b"")

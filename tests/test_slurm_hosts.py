# SPDX-License-Identifier: Apache-2.0
"""What is made of the states that Slurm tells of; a cluster that is a list of them."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pytest

from mjrec.engines import slurm_hosts
from mjrec.engines.gpu_shares import GpuShare
from mjrec.engines.hosting import HostedWork
from mjrec.engines.job_folder import HostState, JobFolder, Pace
from mjrec.engines.slurm_hosts import SlurmHosts
from mjrec.engines.slurm_jobs import ClusterJobs, JobState, NotSubmitted
from mjrec.engines.work import Work
from mjrec.errors import Error


class ToldStates:
    """A cluster whose jobs have the states that a test gives them."""

    def __init__(self) -> None:
        self.told: dict[str, str] = {}
        self.ended: list[str] = []
        self.refuses = False

    def submit(self, count: int) -> list[str]:
        if self.refuses:
            raise NotSubmitted("No job could be submitted: not now")
        new = [str(len(self.told) + n) for n in range(count)]
        self.told.update(dict.fromkeys(new, "PENDING"))
        return new

    def states(self, jobs: Collection[str]) -> dict[str, JobState]:
        return {job: JobState(name=self.told[job], reason="Priority") for job in jobs}

    def end(self, jobs: Collection[str]) -> None:
        self.ended += jobs
        self.told.update(dict.fromkeys(jobs, "CANCELLED"))

    def log_of(self, job: str) -> Path:
        return Path("/no/such/log")


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    hosted = HostedWork.of(Work(entry="a:b"), GpuShare())
    return JobFolder.make(tmp_path / "run", hosted, None)


@pytest.fixture
def told() -> ToldStates:
    return ToldStates()


@pytest.fixture
def hosts(folder: JobFolder, told: ToldStates) -> SlurmHosts:
    cluster: ClusterJobs = told
    return SlurmHosts(folder, cluster, Pace(poll_s=0.01, look_s=0))


def begin(folder: JobFolder, told: ToldStates, host: str) -> None:
    told.told[host.partition("-")[0]] = "RUNNING"
    folder.note_host(host, HostState.WORKING)


def test_as_many_as_are_wanted(hosts: SlurmHosts, told: ToldStates) -> None:
    """Those that wait in the queue count."""
    hosts.want(2)
    hosts.look()
    hosts.want(2)
    assert len(told.told) == 2
    hosts.want(3)
    assert len(told.told) == 3


@pytest.mark.parametrize(
    ("state", "is_to_blame"),
    [
        ("PREEMPTED", False),
        ("NODE_FAIL", False),
        ("CANCELLED", False),
        ("TIMEOUT", False),
        ("FAILED", True),
        ("OUT_OF_MEMORY", True),
        ("GONE", True),
    ],
)
def test_a_host_that_dies_is_replaced(
    hosts: SlurmHosts,
    folder: JobFolder,
    told: ToldStates,
    state: str,
    is_to_blame: bool,
) -> None:
    """What it did may be to blame, or cannot."""
    hosts.want(1)
    begin(folder, told, "0-0")
    assert hosts.look() == {}
    told.told["0"] = state
    dead = hosts.look()
    assert list(dead) == ["0-0"]
    assert dead["0-0"].is_to_blame == is_to_blame
    assert f"the Slurm job 0, which is {state}" in dead["0-0"].how
    assert hosts.logs_to_keep == is_to_blame
    hosts.want(1)
    assert list(told.told) == ["0", "1"]
    assert hosts.look() == dead


def test_one_that_leaves_is_replaced_before_it_has_ended(
    hosts: SlurmHosts, folder: JobFolder, told: ToldStates
) -> None:
    """The queue may be long; it is no death."""
    hosts.want(1)
    begin(folder, told, "0-0")
    folder.note_host("0-0", HostState.LEAVING)
    hosts.look()
    hosts.want(1)
    assert list(told.told) == ["0", "1"]
    folder.note_host("0-0", HostState.ENDED)
    told.told["0"] = "COMPLETED"
    assert hosts.look() == {}
    assert not hosts.logs_to_keep


def test_a_slurm_job_that_slurm_begins_again(
    hosts: SlurmHosts, folder: JobFolder, told: ToldStates
) -> None:
    """What it had taken is free while it waits; nobody takes its place."""
    hosts.want(1)
    begin(folder, told, "0-0")
    hosts.look()
    told.told["0"] = "PENDING"
    assert list(hosts.look()) == ["0-0"]
    hosts.want(1)
    told.told["0"] = "RUNNING"
    hosts.look()
    hosts.want(1)
    begin(folder, told, "0-1")
    assert list(hosts.look()) == ["0-0"]
    hosts.want(1)
    assert list(told.told) == ["0"]


def test_one_that_was_begun_again_unseen(
    hosts: SlurmHosts, folder: JobFolder, told: ToldStates
) -> None:
    """Its earlier host is dead all the same."""
    hosts.want(1)
    begin(folder, told, "0-0")
    hosts.look()
    begin(folder, told, "0-1")
    assert list(hosts.look()) == ["0-0"]


def test_hosts_that_die_before_they_do_anything(
    hosts: SlurmHosts, folder: JobFolder, told: ToldStates
) -> None:
    """Three of them end the run, unless another is at work: then there are no more."""
    hosts.want(4)
    begin(folder, told, "3-0")
    told.told.update(dict.fromkeys("012", "FAILED"))
    hosts.look()
    hosts.check()
    hosts.want(4)
    assert len(told.told) == 4
    told.told["3"] = "PREEMPTED"
    hosts.look()
    with pytest.raises(Error, match="The last one was in the Slurm job 2, which is FA"):
        hosts.check()


def test_a_host_that_does_something_is_a_good_sign(
    hosts: SlurmHosts, folder: JobFolder, told: ToldStates
) -> None:
    """Those that died before may have had bad luck."""
    hosts.want(4)
    begin(folder, told, "3-0")
    told.told.update(dict.fromkeys("012", "FAILED"))
    hosts.look()
    hosts.has_done_something("3-0")
    hosts.want(4)
    assert len(told.told) == 7


def test_a_cluster_that_takes_no_jobs(
    hosts: SlurmHosts, told: ToldStates, caplog: pytest.LogCaptureFixture
) -> None:
    """At first it is an error, and later it is tried again."""
    told.refuses = True
    with pytest.raises(NotSubmitted):
        hosts.want(1)
    told.refuses = False
    hosts.want(1)
    told.refuses = True
    hosts.want(2)
    assert "not now. It is tried again" in caplog.text


def test_a_queue_that_is_long(
    hosts: SlurmHosts,
    told: ToldStates,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a minute the log says what Slurm says."""
    monkeypatch.setattr(slurm_hosts, "_SECONDS_BEFORE_SAYING_WHY", 0)
    hosts.want(2)
    hosts.look()
    assert caplog.messages == [
        "2 Slurm jobs wait for their turn. What Slurm says of 0: PENDING (Priority)."
    ]


def test_the_end_of_all(hosts: SlurmHosts, folder: JobFolder, told: ToldStates) -> None:
    """Those that wait are cancelled, and the others are told and end by themselves."""
    hosts.want(2)
    begin(folder, told, "0-0")
    hosts.look()
    folder.note_host("0-0", HostState.ENDED)
    told.told["0"] = "COMPLETED"
    hosts.end_all()
    assert told.ended == ["1"]
    assert folder.is_stopped

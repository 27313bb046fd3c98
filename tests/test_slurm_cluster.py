# SPDX-License-Identifier: Apache-2.0
"""Of the Slurm engine, what only Slurm can show."""

import contextlib
import functools
import os
import secrets
import signal
import socket
import subprocess
import sys
import time

import pytest
from engine_runs import driver, lines, odd_work, submit, values, wait_for
from waiting import wait_until

from mjrec.engines.jobs import WORK_FOLDER, Run
from mjrec.engines.slurm import SlurmEngine
from mjrec.errors import Error

pytest.importorskip("submitit")

# Slurm looks at its queue once in a while.
until = functools.partial(wait_until, seconds=60)

pytestmark = pytest.mark.slurm


# `low` gives way to `high`: SIGTERM, 20 seconds, SIGKILL.
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={place}/munge.sock
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd.log
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,bf_interval=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
KillWait=20
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=4000 State=UNKNOWN
PartitionName=low Nodes={host} Default=YES PriorityTier=1 GraceTime=20
PartitionName=high Nodes={host} PriorityTier=2 PreemptMode=OFF
"""


@pytest.fixture(scope="module")
def configuration(tmp_path_factory):
    """The configuration file of a cluster that is up: of one machine, this one."""
    place = tmp_path_factory.mktemp("slurm")
    (place / "state").mkdir()
    (place / "spool").mkdir()
    key = place / "munge.key"
    key.touch(0o400)
    key.write_bytes(secrets.token_bytes(1024))
    configuration = place / "slurm.conf"
    configuration.write_text(
        CONFIGURATION.format(
            host=socket.gethostname(), place=place, ports=_free_ports(2)
        )
    )
    # By default slurmd looks for a mounted cgroup file system, which a change of root
    # has none of, and ends where there is none.
    (place / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    environ = {**os.environ, "SLURM_CONF": str(configuration)}
    daemons = [
        [
            *("munged", "--force", "--foreground", f"--key-file={key}"),
            *(f"--socket={place}/munge.sock", f"--pid-file={place}/munge.pid"),
            *(f"--seed-file={place}/munge.seed", f"--log-file={place}/munge.log"),
        ],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    ]
    with contextlib.ExitStack() as stack:
        for command in daemons:
            stack.enter_context(_running(command, environ, place))
        _wait_until_up(environ)
        yield configuration


@contextlib.contextmanager
def _running(command, environ, place):
    with (
        (place / f"{command[0]}.out").open("wb") as said,
        subprocess.Popen(command, env=environ, stdout=said, stderr=said) as process,
    ):
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()


def _wait_until_up(environ):
    deadline = time.monotonic() + 60
    while True:
        asked = subprocess.run(
            ["sinfo", "--noheader", "--format=%T"],
            env=environ,
            capture_output=True,
            text=True,
            check=False,
        )
        if asked.stdout.split()[:1] == ["idle"]:
            return
        assert time.monotonic() < deadline, asked
        time.sleep(0.1)


def _free_ports(count):
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


@pytest.fixture(autouse=True)
def cluster(configuration, monkeypatch):
    """Nothing is left in its queue by any test."""
    monkeypatch.setenv("SLURM_CONF", str(configuration))
    yield
    until(lambda: not asked("squeue", "--noheader"))


def asked(*command):
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not done.returncode, (command, done.stderr)
    return done.stdout.strip()


def work(place):
    return odd_work(shared=place / "shared", left=str(place / "left"))


def hold(run, place):
    submit(run, "held", do="hold", begun=str(place / "begun"))


def slurm_job():
    """Return the only one that runs."""
    return asked("squeue", "--noheader", "--array", "--states=running", "--format=%i")


def test_jobs_are_done_in_slurm_jobs(tmp_path):
    """Which are submitted as one array, and have completed at the end.

    So they do when they take a moment more than their work does.
    """
    with Run(SlurmEngine(3, setup=["trap 'sleep 1' EXIT"]), work(tmp_path)) as run:
        for number in range(50):
            run.submit(str(number), do="where")
        found = [outcome for outcome in run.results() if outcome is not None]
        logs = (tmp_path / "shared").rglob("*_0_log.out")
        submitted = {path.name.removesuffix("_0_log.out") for path in logs}
    assert len(found) == 50
    assert not [outcome.failure for outcome in found if outcome.failure]
    [array] = {number.partition("_")[0] for number in submitted}
    assert submitted == {f"{array}_{n}" for n in range(12)}
    states = asked("squeue", "--noheader", "--states=all", "-j", array, "--format=%T")
    assert set(states.split()) == {"COMPLETED"}
    assert not list((tmp_path / "shared").iterdir())


@pytest.mark.parametrize("how", ["preempted", "cancelled", "killed"])
def test_a_slurm_job_that_is_ended(tmp_path, how, caplog):
    """Files are closed where there is time; what it was at is done in another."""
    with Run(SlurmEngine(1, partition="low"), work(tmp_path)) as run:
        hold(run, tmp_path)
        wait_for(tmp_path / "begun", run)
        first = slurm_job()
        (tmp_path / "begun").unlink()
        if how == "preempted":
            # Needs the whole machine for a moment.
            asked("srun", "--partition=high", "--cpus-per-task=4", "true")
        else:
            options = ["--signal=KILL", "--full"] if how == "killed" else []
            asked("scancel", *options, first)
        until(
            lambda: wait_for(tmp_path / "begun", run) and slurm_job() not in (first, "")
        )
    assert "No Slurm job" not in caplog.text
    assert lines(tmp_path / "left")


@pytest.mark.parametrize("how", ["requeued", "notice"])
def test_a_slurm_job_that_is_put_back_into_the_queue(tmp_path, how):
    """It does its work once more, under its number, in a new process.

    Takes two minutes, for which Slurm holds such a job back.
    """
    go = tmp_path / "go"
    with Run(SlurmEngine(1), work(tmp_path)) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"), go=str(go))
        first = wait_for(tmp_path / "begun", run)
        number = slurm_job()
        options = ("scancel", "--signal=USR2", "--full")
        asked(*(options if how == "notice" else ("scontrol", "requeue")), number)
        wait_until(lambda: len(lines(tmp_path / "begun")) == 2, seconds=200)
        assert slurm_job() == number
        go.touch()
        [value] = values(run)
    assert [str(first), str(value["pid"])] == lines(tmp_path / "begun")
    assert lines(tmp_path / "left")[0] == str(first)


def test_what_the_drivers_slurm_job_was_given_is_not_passed_on(tmp_path, monkeypatch):
    """Where the cluster is is."""
    monkeypatch.setenv("SLURM_JOB_ID", "9999")
    monkeypatch.setenv("SLURM_MEM_PER_GPU", "1")
    made = SlurmEngine(1, setup=[f"env > {tmp_path / 'environ'}"])
    with Run(made, work(tmp_path)) as run:
        run.submit("a", do="echo")
        assert next(run.results()) is not None
    given = dict(line.partition("=")[::2] for line in lines(tmp_path / "environ"))
    assert given["SLURM_CONF"] == os.environ["SLURM_CONF"]
    assert given["SLURM_JOB_ID"] != "9999"
    assert "SLURM_MEM_PER_GPU" not in given
    assert os.environ["SLURM_MEM_PER_GPU"] == "1"


def test_what_slurm_refuses(tmp_path):
    """The error has its words."""
    with Run(SlurmEngine(1, partition="none"), work(tmp_path)) as run:
        hold(run, tmp_path)
        with pytest.raises(Error, match=r"No job could be submitted: .*partition"):
            next(run.results())


def test_the_next_driver_ends_what_a_killed_one_has_left(tmp_path):
    """Those that wait in the queue too."""
    with driver(tmp_path, "SlurmEngine(2)") as process:
        process.kill()
    [pid] = lines(tmp_path / "begun")
    with Run(SlurmEngine(1), work(tmp_path)) as run:
        run.submit("a", do="echo")
        assert next(run.results()) is not None
        until(lambda: pid in lines(tmp_path / "left"))
    assert not (tmp_path / "shared" / WORK_FOLDER).exists()


def test_an_evaluation_whose_driver_is_in_a_slurm_job(tmp_path):
    """Byte for byte that of one process."""
    command = [
        *(sys.executable, "-m", "mjrec", "evaluate", "InvertedPendulum-v5"),
        *("--policy", "random", "--keep", "none"),
        *("--episodes", "2", "--num-seeds", "2", "--max-steps", "5"),
    ]
    asked(*command, "--out", str(tmp_path / "here"))
    small_job = ("srun", "--cpus-per-task=1", "--mem-per-cpu=10")
    there = str(tmp_path / "there")
    engine_options = ("--engine", "slurm", "--engine-option", "mem_gb=0.5")
    asked(*small_job, *command, "--out", there, *engine_options)
    for name in ("results.csv", "results.json"):
        one, other = (tmp_path / place / name for place in ("here", "there"))
        assert one.read_bytes() == other.read_bytes()

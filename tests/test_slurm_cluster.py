# SPDX-License-Identifier: Apache-2.0
"""The Slurm engine on a real Slurm cluster of one machine."""

import contextlib
import functools
import os
import secrets
import signal
import socket
import subprocess
import sys

import pytest
from engine_runs import driver, lines, odd_work, submit, values, wait_for
from waiting import wait_until

from mjrec.engines.jobs import WORK_FOLDER, Run
from mjrec.engines.slurm import SlurmEngine
from mjrec.errors import Error

pytest.importorskip("submitit")

# Slurm checks its queue every few seconds.
until = functools.partial(wait_until, seconds=60)

pytestmark = pytest.mark.slurm


# `low` gives way to `high`: SIGTERM, 20 seconds, SIGKILL.
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.sock
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
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
    """Start a cluster on this machine, and return its configuration file."""
    folder = tmp_path_factory.mktemp("slurm")
    (folder / "state").mkdir()
    (folder / "spool").mkdir()
    key = folder / "munge.key"
    key.touch(0o400)
    key.write_bytes(secrets.token_bytes(1024))
    configuration = folder / "slurm.conf"
    values = {"host": socket.gethostname(), "folder": folder, "ports": _free_ports(2)}
    configuration.write_text(CONFIGURATION.format(**values))
    # By default slurmd needs a mounted cgroup file system, which a chroot lacks.
    (folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    environ = {**os.environ, "SLURM_CONF": str(configuration)}
    daemons = [
        [
            *("munged", "--force", "--foreground", f"--key-file={key}"),
            *(f"--socket={folder}/munge.sock", f"--pid-file={folder}/munge.pid"),
            *(f"--seed-file={folder}/munge.seed", f"--log-file={folder}/munge.log"),
        ],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    ]
    with contextlib.ExitStack() as stack:
        for command in daemons:
            stack.enter_context(_running(command, environ, folder))
        sinfo = ("sinfo", "--noheader", "--format=%T")
        until(lambda: _run(*sinfo, env=environ).stdout.split()[:1] == ["idle"])
        yield configuration


@contextlib.contextmanager
def _running(command, environ, folder):
    with (
        (folder / f"{command[0]}.out").open("wb") as out,
        subprocess.Popen(command, env=environ, stdout=out, stderr=out) as process,
    ):
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()


def _run(*command, **options):
    return subprocess.run(
        command, capture_output=True, text=True, check=False, **options
    )


def _free_ports(count):
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


@pytest.fixture(autouse=True)
def cluster(configuration, monkeypatch):
    """Check that each test leaves the queue empty."""
    monkeypatch.setenv("SLURM_CONF", str(configuration))
    yield
    until(lambda: not output("squeue", "--noheader"))


def output(*command):
    done = _run(*command)
    assert not done.returncode, (command, done.stderr)
    return done.stdout.strip()


def work(folder):
    return odd_work(shared=folder / "shared", left=str(folder / "left"))


def hold(run, folder):
    submit(run, "held", do="hold", begun=str(folder / "begun"))


def slurm_job():
    """Return the number of the only running job."""
    return output("squeue", "--noheader", "--array", "--states=running", "--format=%i")


def test_slurm_jobs_are_one_array_and_complete(tmp_path):
    """Even if a job takes a second longer than its work."""
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
    states = output("squeue", "--noheader", "--states=all", "-j", array, "--format=%T")
    assert set(states.split()) == {"COMPLETED"}
    assert not list((tmp_path / "shared").iterdir())


@pytest.mark.parametrize("how", ["preempted", "cancelled", "killed"])
def test_work_of_an_ended_slurm_job_is_done_in_another(tmp_path, how, caplog):
    with Run(SlurmEngine(1, partition="low"), work(tmp_path)) as run:
        hold(run, tmp_path)
        wait_for(tmp_path / "begun", run)
        first = slurm_job()
        (tmp_path / "begun").unlink()
        if how == "preempted":
            # It needs all CPUs.
            output("srun", "--partition=high", "--cpus-per-task=4", "true")
        else:
            options = ["--signal=KILL", "--full"] if how == "killed" else []
            output("scancel", *options, first)
        until(
            lambda: wait_for(tmp_path / "begun", run) and slurm_job() not in (first, "")
        )
    assert "No Slurm job" not in caplog.text
    assert lines(tmp_path / "left")


# Takes two minutes: Slurm delays a requeued job.
@pytest.mark.parametrize("how", ["requeued", "notice"])
def test_requeued_slurm_job_repeats_its_work_in_a_new_process(tmp_path, how):
    go = tmp_path / "go"
    with Run(SlurmEngine(1), work(tmp_path)) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"), go=str(go))
        first = wait_for(tmp_path / "begun", run)
        number = slurm_job()
        options = ("scancel", "--signal=USR2", "--full")
        output(*(options if how == "notice" else ("scontrol", "requeue")), number)
        wait_until(lambda: len(lines(tmp_path / "begun")) == 2, seconds=200)
        assert slurm_job() == number
        go.touch()
        [value] = values(run)
    assert [str(first), str(value["pid"])] == lines(tmp_path / "begun")
    assert lines(tmp_path / "left")[0] == str(first)


def test_only_slurm_conf_is_passed_on_from_the_drivers_slurm_job(tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "9999")
    monkeypatch.setenv("SLURM_MEM_PER_GPU", "1")
    engine = SlurmEngine(1, setup=[f"env > {tmp_path / 'environ'}"])
    with Run(engine, work(tmp_path)) as run:
        run.submit("a", do="echo")
        assert next(run.results()) is not None
    environ = dict(line.partition("=")[::2] for line in lines(tmp_path / "environ"))
    assert environ["SLURM_CONF"] == os.environ["SLURM_CONF"]
    assert environ["SLURM_JOB_ID"] != "9999"
    assert "SLURM_MEM_PER_GPU" not in environ
    assert os.environ["SLURM_MEM_PER_GPU"] == "1"


def test_refused_submission_shows_slurms_message(tmp_path):
    with Run(SlurmEngine(1, partition="none"), work(tmp_path)) as run:
        hold(run, tmp_path)
        with pytest.raises(Error, match=r"No job could be submitted: .*partition"):
            next(run.results())


def test_next_driver_ends_running_and_queued_jobs_of_a_killed_one(tmp_path):
    with driver(tmp_path, "SlurmEngine(2)") as process:
        process.kill()
    [pid] = lines(tmp_path / "begun")
    with Run(SlurmEngine(1), work(tmp_path)) as run:
        run.submit("a", do="echo")
        assert next(run.results()) is not None
        until(lambda: pid in lines(tmp_path / "left"))
    assert not (tmp_path / "shared" / WORK_FOLDER).exists()


def test_evaluation_from_a_slurm_job_equals_that_of_one_process(tmp_path):
    command = [
        *(sys.executable, "-m", "mjrec", "evaluate", "InvertedPendulum-v5"),
        *("--policy", "random", "--keep", "none"),
        *("--episodes", "2", "--num-seeds", "2", "--max-steps", "5"),
    ]
    output(*command, "--out", str(tmp_path / "here"))
    small_job = ("srun", "--cpus-per-task=1", "--mem-per-cpu=10")
    there = str(tmp_path / "there")
    engine_options = ("--engine", "slurm", "--engine-option", "mem_gb=0.5")
    output(*small_job, *command, "--out", there, *engine_options)
    for name in ("results.csv", "results.json"):
        one, other = (tmp_path / side / name for side in ("here", "there"))
        assert one.read_bytes() == other.read_bytes()

# SPDX-License-Identifier: Apache-2.0
"""A Slurm cluster of one machine, this one, for tests."""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import time

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


@contextlib.contextmanager
def slurm_cluster(place):
    """Yield the configuration file of a cluster that is up."""
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

# SPDX-License-Identifier: Apache-2.0
"""Ray clusters of several nodes on this machine, for tests."""

import contextlib
import logging
import os
import re
from pathlib import Path

import pytest
import ray
from ray.cluster_utils import Cluster
from waiting import wait_until

MARK = "MJREC_TEST_OF_RAY"
AGENT = re.compile(r"ray::\w+Agent")
SMALL_STORE = 80 << 20


@contextlib.contextmanager
def home_for_ray(home):
    """Let Ray start from an empty home, and see that nothing of it is left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.setenv(MARK, str(os.getpid()))
        patch.setenv("RAY_AUTH_TOKEN", "0" * 64)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        patch.delenv("RAY_ADDRESS", raising=False)
        yield
    assert not ray.is_initialized()
    assert not list(home.iterdir())
    mark = f"{MARK}={os.getpid()}"
    wait_until(
        lambda: not ray_processes(mark), seconds=30, told=lambda: ray_processes(mark)
    )


@contextlib.contextmanager
def own_ray(*, cpus):
    """Have a Ray that this process has started for itself."""
    ray.init(
        address="local",
        num_cpus=cpus,
        include_dashboard=False,
        object_store_memory=SMALL_STORE,
        logging_level=logging.ERROR,
    )
    try:
        yield ray
    finally:
        ray.shutdown()


@contextlib.contextmanager
def cluster_of(*nodes):
    """Have a cluster with a head on which nothing runs, and such nodes."""
    head = {
        "num_cpus": 0,
        "include_dashboard": False,
        "object_store_memory": SMALL_STORE,
    }
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for node in nodes:
            cluster.add_node(object_store_memory=SMALL_STORE, **node)
        yield cluster
    finally:
        cluster.shutdown()


def is_gone(pid):
    return not Path(f"/proc/{pid}").exists()


def ray_processes(mark):
    """Return the commands of processes in whose environment something stands.

    Without Ray's agents, which tell a cluster for a minute that it is gone.
    """
    found = []
    for process in Path("/proc").iterdir():
        if process.name == str(os.getpid()):
            continue
        with contextlib.suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes():
                command = (process / "cmdline").read_bytes().replace(b"\0", b" ")
                found.append(command.decode(errors="replace"))
    # Nor Python's own, which Dask's processes start.
    return [c for c in found if not AGENT.match(c) and "resource_tracker" not in c]

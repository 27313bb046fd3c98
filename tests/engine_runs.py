# SPDX-License-Identifier: Apache-2.0
"""Runs of `odd_jobs` on engines, and the processes that they start."""

import contextlib
import functools
import os
import re
import select
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from waiting import wait_until

from mjrec.engines.choice import engine_from
from mjrec.engines.jobs import Work
from mjrec.engines.local import LocalEngine
from mjrec.engines.ray import RayEngine
from mjrec.engines.slurm import SlurmEngine

# This environment variable marks the processes that a test has started.
MARK = "MJREC_TEST_MARK"


@contextlib.contextmanager
def each_engine(home):
    """Yield a function from kind and workers to an engine; clusters start once."""
    from ray_clusters import home_for_ray, own_ray

    with contextlib.ExitStack() as clusters:

        @functools.cache
        def dask(workers):
            import distributed

            cluster = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=":0"
            )
            return clusters.enter_context(cluster).scheduler_address

        @functools.cache
        def ray():
            clusters.enter_context(home_for_ray(home))
            clusters.enter_context(own_ray(cpus=2))

        def engine(kind, workers):
            if kind == "slurm":
                pytest.importorskip("submitit")
                return SlurmEngine(workers, cluster="local")
            if kind == "dask":
                return engine_from(f"dask:{dask(workers)}")
            if kind == "ray":
                ray()
            kinds = {"local": LocalEngine, "own": ThreadPoolExecutor, "ray": RayEngine}
            return kinds[kind](workers)

        yield engine


def odd_work(make="make", *, shared=None, **settings):
    """Return work of `odd_jobs`."""
    return Work(entry=f"odd_jobs:{make}", settings=settings, shared_directory=shared)


def submit(run, *jobs, **arguments):
    """Submit jobs with the same arguments."""
    for key in jobs:
        run.submit(key, **arguments)


def outcomes(run):
    """Return the outcomes of all jobs by key, in order of completion."""
    return {outcome.key: outcome for outcome in run.results() if outcome is not None}


def values(run):
    """Return the values of all jobs, none of which may fail."""
    found = outcomes(run).values()
    assert not [outcome.failure for outcome in found if outcome.failure]
    return [dict(outcome.value or {}) for outcome in found]


def wait_for(path, run):
    """Return the process id that a job writes to `path` when it starts."""
    for _ in run.results(timeout_s=0.02):
        if path.exists() and path.read_text():
            break
    return int(path.read_text().split()[-1])


def marked(mark):
    """Return the commands of processes that have the mark in their environment.

    Ray's agents, which end a minute later, and Python's resource tracker are left out.
    """
    wanted, found = f"{MARK}={mark}".encode(), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if wanted in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_text().replace("\0", " "))
    return [c for c in found if not re.match(r"ray::\w+Agent|.*resource_tracker", c)]


DRIVER = """
import sys
from pathlib import Path
import mjrec
from engine_runs import odd_work, submit
from mjrec.engines.jobs import Run
from mjrec.signals import exiting_on_signals
directory = Path(sys.argv[1])
work = odd_work(shared=directory / "shared", left=str(directory / "left"))
with exiting_on_signals(), Run(eval(f"mjrec.{sys.argv[2]}"), work) as run:
    submit(run, "held", do="hold", begun=str(directory / "begun"))
    submit(run, *map(str, range(20)), do="echo")
    list(run.results())
"""


@contextlib.contextmanager
def driver(directory, engine, **environ):
    """Start a driver in a new session, and wait until it runs a job."""
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(directory), engine],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), **environ},
        start_new_session=True,
    ) as process:
        wait_until(lambda: lines(directory / "begun"), seconds=120)
        yield process


def wait_for_end(pid):
    """Wait until a process, which need not be a child, has ended."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        ready, _, _ = select.select([descriptor], [], [], 30)
        os.close(descriptor)
        assert ready, f"process {pid} is still running"


def lines(path):
    """Return the lines of a file, or none if it is missing."""
    return path.read_text().splitlines() if path.exists() else []


def run_python(*arguments, text=None, **environ):
    """Run Python with these helpers in its path, and return its output."""
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), **environ},
        input=text,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout

# SPDX-License-Identifier: Apache-2.0
"""What tests do with a run, on whichever engine."""

import contextlib
import os
import re
import select
import subprocess
import sys
from pathlib import Path

from mjrec.engines.jobs import Work

# An environment variable, by which a test finds what it has started.
MARK = "MJREC_TEST_MARK"


def odd_work(make="make", *, shared=None, **settings):
    """Return work of `odd_jobs`."""
    return Work(entry=f"odd_jobs:{make}", settings=settings, shared_directory=shared)


def submit(run, *jobs, **arguments):
    """Hand out jobs that differ in nothing but their keys."""
    for key in jobs:
        run.submit(key, **arguments)


def outcomes(run):
    """Return what becomes of all jobs, in the order in which it comes."""
    return {outcome.key: outcome for outcome in run.results() if outcome is not None}


def values(run):
    """Return what the handlers return; no job may fail."""
    found = outcomes(run).values()
    assert not [outcome.failure for outcome in found if outcome.failure]
    return [dict(outcome.value or {}) for outcome in found]


def wait_for(path, run):
    """Return the number of the process that has begun a job, which notes it there."""
    for _ in run.results(timeout_s=0.02):
        if path.exists() and path.read_text():
            break
    return int(path.read_text().split()[-1])


def marked(mark):
    """Return the commands of other processes in whose environment the mark stands.

    Without Ray's agents, which tell a cluster for a minute that it is gone, and
    without Python's own.
    """
    wanted, found = f"{MARK}={mark}".encode(), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if wanted in (process / "environ").read_bytes().split(b"\0"):
                found.append((process / "cmdline").read_text().replace("\0", " "))
    return [c for c in found if not re.match(r"ray::\w+Agent|.*resource_tracker", c)]


def wait_for_end(pid):
    """Wait until a process that need not be a child is gone."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        ready, _, _ = select.select([descriptor], [], [], 30)
        os.close(descriptor)
        assert ready, f"process {pid} goes on"


def lines(path):
    """Return the lines of a file; none where there is no file."""
    return path.read_text().splitlines() if path.exists() else []


def run_python(*arguments, text=None, **environ):
    """Run Python, which finds these helpers, and return what it prints."""
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

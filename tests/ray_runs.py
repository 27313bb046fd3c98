# SPDX-License-Identifier: Apache-2.0
"""Small runs on Ray, for tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from mjrec.engines.ray import RayEngine, RayRun
from mjrec.engines.work import Job, JobOutcome, Work


def begun(
    workers: int | None = 1,
    *,
    entry: str = "odd_jobs:make",
    engine: RayEngine | None = None,
    **settings: Any,
) -> RayRun:
    work = Work(entry=entry, settings=settings)
    return (engine or RayEngine(workers)).begin(work)


def submit(run: RayRun, *jobs: str, **arguments: Any) -> None:
    for key in jobs:
        run.submit(Job(key=key, arguments=arguments))


def outcomes(run: RayRun) -> dict[str, JobOutcome]:
    return {outcome.key: outcome for outcome in run.results() if outcome is not None}


def values(run: RayRun) -> list[dict[str, Any]]:
    found = outcomes(run).values()
    assert not [outcome.failure for outcome in found if outcome.failure]
    return [dict(outcome.value or {}) for outcome in found]


def wait_for(path: Path, run: RayRun) -> int:
    """Return the number of the process that has begun a job, which notes it there."""
    for _ in run.results(patience_s=0.05):
        if path.exists() and path.read_text():
            break
    return int(path.read_text())


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def run_python(script: str, *arguments: str, **environ: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), **environ},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout

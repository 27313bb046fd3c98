# SPDX-License-Identifier: Apache-2.0
"""What tests do with a run, of whichever engine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjrec.engines.work import Job, JobOutcome, Run


def submit(run: Run, *jobs: str, **arguments: Any) -> None:
    """Hand out jobs that differ in nothing but their keys."""
    for key in jobs:
        run.submit(Job(key=key, arguments=arguments))


def outcomes(run: Run) -> dict[str, JobOutcome]:
    """Return what becomes of all jobs, in the order in which it comes."""
    return {outcome.key: outcome for outcome in run.results() if outcome is not None}


def values(run: Run) -> list[dict[str, Any]]:
    """Return what the handlers return; no job may fail."""
    found = outcomes(run).values()
    assert not [outcome.failure for outcome in found if outcome.failure]
    return [dict(outcome.value or {}) for outcome in found]


def wait_for(path: Path, run: Run) -> int:
    """Return the number of the process that has begun a job, which notes it there."""
    for _ in run.results(patience_s=0.02):
        if path.exists() and path.read_text():
            break
    return int(path.read_text())


def lines(path: Path) -> list[str]:
    """Return the lines of a file; none where there is no file."""
    return path.read_text().splitlines() if path.exists() else []

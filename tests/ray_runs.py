# SPDX-License-Identifier: Apache-2.0
"""Small runs on Ray, for tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from mjrec.engines.ray import RayEngine, RayRun
from mjrec.engines.work import Work


def begun(
    workers: int | None = 1,
    *,
    entry: str = "odd_jobs:make",
    engine: RayEngine | None = None,
    **settings: Any,
) -> RayRun:
    work = Work(entry=entry, settings=settings)
    return (engine or RayEngine(workers)).begin(work)


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

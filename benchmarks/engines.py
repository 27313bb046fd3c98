# SPDX-License-Identifier: Apache-2.0
"""The overhead that an engine adds to the jobs that it distributes."""

from __future__ import annotations

import functools
import importlib.util
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjrec.engines.choice import engine_from
from mjrec.engines.jobs import Run, Work

from .children import call
from .process_memory import peak_memory
from .results import Result, at_most
from .rounds import Say, take_turns

TITLE = "Engines: empty jobs"

_NUMBERS = (
    ("first outcome", "s", None),
    ("each further job", "ms", at_most(5)),
    ("memory of a worker", "MB", None),
)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        engines: the engines to measure, except those that are not there.
        workers: numbers of local workers to measure with. A cluster has two workers.
        jobs: number of jobs to distribute.
    """

    rounds: int = 5
    engines: tuple[str, ...] = ("local", "slurm", "ray")
    workers: tuple[int, ...] = (1, 2, 8)
    jobs: int = 10_000


FULL = Settings()
QUICK = Settings(rounds=3, jobs=1000)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the startup time, the time per further job, and the memory per worker."""
    cases = [
        (engine, workers)
        for engine in filter(_is_there, settings.engines)
        for workers in (settings.workers if engine == "local" else (2,))
    ]
    samples = take_turns(
        {
            (engine, workers): functools.partial(
                call, hand_out, engine=engine, workers=workers, jobs=settings.jobs
            )
            for engine, workers in cases
        },
        rounds=settings.rounds,
        say=say,
    )
    return [
        Result(
            subject=f"{engine}, {workers} worker" + "s" * (workers > 1),
            variant=variant,
            unit=unit,
            samples=tuple(sample[index] for sample in samples[engine, workers]),
            promise=promise,
        )
        for engine, workers in cases
        for index, (variant, unit, promise) in enumerate(_NUMBERS)
    ]


def _is_there(engine: str) -> bool:
    if engine == "ray":
        return importlib.util.find_spec("ray") is not None
    if engine == "slurm":
        # Slurm's commands may be installed where no cluster answers.
        return shutil.which("sinfo") is not None and not subprocess.call(
            "sinfo", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
    return True


class Idle:
    """A handler that does nothing, but loads all that an evaluation's worker loads.

    Args:
        settings: not used.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        # Imported here because the process that distributes the jobs needs none of it.
        import gymnasium

        import mjrec.evaluation.worker

        del settings, mjrec
        gymnasium.make("InvertedPendulum-v5").reset()

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the worker's peak memory."""
        del arguments
        return {"peak": peak_memory()}


def hand_out(engine: str, workers: int, jobs: int) -> list[float]:
    """Return the seconds to the first result, ms per further job, and a worker's MB."""
    with (
        # All nodes of a cluster must see the directory, as they must see this package.
        tempfile.TemporaryDirectory(prefix=".engines-", dir=Path.cwd()) as shared,
        engine_from(engine, workers=workers) as executor,
    ):
        start = time.perf_counter()
        entry = f"{__name__}:{Idle.__name__}"
        with Run(executor, Work(entry=entry, shared_directory=Path(shared))) as run:
            run.submit("first")
            outcome = next(iter(run.results()))
            assert outcome is not None
            first = time.perf_counter() - start
            for number in range(jobs):
                run.submit(str(number))
            # The first half is not timed, so that all workers have started.
            results = run.results()
            for _ in range(jobs // 2):
                next(results)
            begin = time.perf_counter()
            rest = sum(1 for _ in results)
            seconds = time.perf_counter() - begin
    peak: float = (outcome.value or {})["peak"]
    return [first, 1000 * seconds / rest, peak]

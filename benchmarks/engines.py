# SPDX-License-Identifier: Apache-2.0
"""The overhead that an engine adds to the jobs that it distributes."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mjrec.engines.jobs import Run, Work
from mjrec.engines.local import LocalEngine

from .children import call
from .process_memory import peak_memory
from .results import Result
from .rounds import Say, take_turns

TITLE = "Engines: empty jobs in local processes"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        workers: numbers of workers to measure with.
        jobs: number of jobs to distribute.
    """

    rounds: int = 5
    workers: tuple[int, ...] = (1, 2, 8)
    jobs: int = 10_000


FULL = Settings()
QUICK = Settings(rounds=3, jobs=1000)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the startup time, the job rate and the memory per worker."""
    samples = take_turns(
        {
            count: functools.partial(call, hand_out, workers=count, jobs=settings.jobs)
            for count in settings.workers
        },
        rounds=settings.rounds,
        say=say,
    )
    return [
        Result(
            subject=f"{count} worker" + "s" * (count > 1),
            variant=variant,
            unit=unit,
            samples=tuple(sample[index] for sample in samples[count]),
        )
        for count in settings.workers
        for index, (variant, unit) in enumerate(
            (
                ("first outcome", "s"),
                ("outcomes", "jobs/s"),
                ("memory of a worker", "MB"),
            )
        )
    ]


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


def hand_out(workers: int, jobs: int) -> list[float]:
    """Return the seconds to the first result, results per second, and a worker's MB."""
    start = time.perf_counter()
    work = Work(entry=f"{__name__}:{Idle.__name__}")
    with Run(LocalEngine(workers), work) as run:
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
    return [first, rest / seconds, peak]

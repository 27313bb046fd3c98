# SPDX-License-Identifier: Apache-2.0
"""Jobs done by the workers of an engine: handing them out, and doing one.

The process that hands them out opens no trajectory and draws nothing. It may be killed
at any time, and what its workers have finished stays. The settings of the workers may
be `{"models": [sha256, ...]}`: compiled models that the user whose jobs they are has
stored, and that the workers load. What comes back is `{"outcome": {...}}`, null where
nothing was left to do.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.jobs import Job, JobOutcome, Run, Work
from ..simulation.model_trust import TRUST_VARIABLE, note_models, stored_models
from .finish import Finisher, note_failure
from .jobs import Outcome, VideoJob
from .progress import Progress
from .recordings import may_be_left

_WORKER = "mjrec.rendering.engine_jobs:VideoWorker"
_RASTERISER_THREADS = "LP_NUM_THREADS"


def do_on_engine(
    engine: Executor,
    jobs: Iterable[VideoJob],
    *,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[Outcome]:
    """Do what `do_jobs` does, by the workers of an engine.

    Outcomes come in the order in which they are over.

    Args:
        engine: whose workers.
        jobs: which, in directories that all workers see.
        on_progress: called when a job is over.

    Raises:
        Error: the engine cannot do any work.
    """
    by_name = {
        f"video/{job.nothing.name}": job
        for job in jobs
        if job.variant is not None or may_be_left(job.directory, job.key)
    }
    if not by_name:
        return
    now = Progress(videos=len(by_name), frames=None)
    on_progress(now)
    directories = list(dict.fromkeys(job.directory for job in by_name.values()))
    work = Work(
        entry=_WORKER,
        # Workers elsewhere may have another home, and no list of this user's models.
        settings={"models": stored_models(directories)},
        environ=environ_for_drawing(),
        shared_directory=directories[0].absolute(),
    )
    with Run(engine, work) as run:
        for name, job in by_name.items():
            run.submit(Job(key=name, arguments=job.as_json()))
        for done in run.results():
            # Without patience there is always one.
            assert done is not None
            job = by_name[done.key]
            outcome = outcome_of(done, job)
            now = _counted(now, outcome)
            on_progress(now)
            if outcome is not None:
                yield replace(outcome, directory=job.nothing.directory)


def outcome_of(done: JobOutcome, job: VideoJob) -> Outcome | None:
    """Return what became of a job; None where nothing was to be done."""
    if done.failure is not None:
        if job.variant is None:
            # Its worker has died, and could not.
            note_failure(job.directory, job.nothing.name, done.failure)
        return replace(job.nothing, failure=done.failure)
    assert done.value is not None
    said = done.value["outcome"]
    return None if said is None else Outcome.from_json(said)


def environ_for_drawing() -> dict[str, str]:
    """Return environment variables of workers that draw, wherever they are."""
    # There are several, and Mesa's rasteriser would start as many threads as there are
    # CPUs in each of them.
    environ = {_RASTERISER_THREADS: os.environ.get(_RASTERISER_THREADS, "1")}
    if TRUST_VARIABLE in os.environ:
        # Those on other machines do not have it from this process.
        environ[TRUST_VARIABLE] = os.environ[TRUST_VARIABLE]
    return environ


class VideoWorker:
    """Does one job after the other; a handler of `engines.jobs`.

    A process of its own draws, which stays from job to job.

    Args:
        settings: see the module.
        payload: there is none.
    """

    def __init__(
        self, settings: Mapping[str, Any] | None = None, payload: bytes | None = None
    ) -> None:
        del payload
        note_models((settings or {}).get("models", ()))
        # With a number of workers no directory's CPUs are shared.
        self._finisher = Finisher(Path(), workers=1)

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job."""
        job = VideoJob.from_json(arguments)
        outcome = self._finisher.do_next()[1] if self._finisher.add(job) else None
        return {"outcome": None if outcome is None else outcome.as_json()}

    def close(self) -> None:
        """End the process that draws."""
        self._finisher.close()


def _counted(now: Progress, outcome: Outcome | None) -> Progress:
    """Count a job that is over, which was taken for one video."""
    if outcome is None or outcome.is_trajectory:
        return replace(now, videos=now.videos - 1)
    further = len(outcome.further_videos)
    return replace(
        now,
        videos=now.videos + further,
        videos_done=now.videos_done + 1 + further,
        frames_done=now.frames_done + (1 + further) * outcome.frame_count,
    )

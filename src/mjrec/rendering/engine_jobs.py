# SPDX-License-Identifier: Apache-2.0
"""Jobs done by the workers of an engine: handing them out, and doing one.

The process that hands them out opens no trajectory and draws nothing. It may be killed
at any time, and what its workers have finished stays. The settings of the workers may
be `{"models": [sha256, ...]}`: compiled models that the user whose jobs they are has
stored, and that the workers load. What comes back is a `RenderedVideos`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

from ..engines.jobs import JobOutcome, Run, Work
from ..formats.dataclass_json import from_json, to_json
from ..simulation.model_trust import TRUST_VARIABLE, note_models, stored_models
from .finisher import Finisher, note_failure
from .jobs import Progress, RenderedVideos, VideoJob
from .pool import WorkerPool
from .recordings import may_be_left

_WORKER = "mjrec.rendering.engine_jobs:VideoWorker"
_RASTERISER_THREADS = "LP_NUM_THREADS"


def do_on_engine(
    engine: Executor,
    jobs: Iterable[VideoJob],
    *,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[RenderedVideos]:
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
        # Of several directories, which may have files of one name.
        job.name: job
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
            run.submit(name, **to_json(_everywhere(job)))
        for done in run.results():
            # Without timeout there is always one.
            assert done is not None
            result = result_of(done, by_name[done.key])
            # It was taken for one video.
            count = len(result.videos)
            videos = count or int(bool(result.failures or result.elsewhere))
            now = Progress(
                videos=now.videos + videos - 1,
                videos_done=now.videos_done + videos,
                frames_done=now.frames_done + sum(result.videos.values()),
                frames=None,
            )
            on_progress(now)
            if not result.is_empty:
                yield result


def result_of(done: JobOutcome, job: VideoJob) -> RenderedVideos:
    """Return the result of a job that an engine's worker did."""
    directory = job.directory if job.video is None else job.video.parent
    if done.failure is not None:
        if job.variant is None:
            # Its worker has died, and could not.
            note_failure(job.directory, _name_of(job), done.failure)
        failures = {_name_of(job): done.failure}
        return RenderedVideos(directory=directory, failures=failures)
    assert done.value is not None
    # Under the name by which this process knows it.
    return replace(from_json(RenderedVideos, done.value), directory=directory)


def _everywhere(job: VideoJob) -> VideoJob:
    """Return a job with paths that mean the same in other working directories."""
    video = None if job.video is None else job.video.absolute()
    return replace(job, directory=job.directory.absolute(), video=video)


def _name_of(job: VideoJob) -> str:
    return job.key.shown_name if job.video is None else job.video.name


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
    """

    def __init__(self, settings: Mapping[str, Any] | None = None) -> None:
        note_models((settings or {}).get("models", ()))
        # With a number of workers no directory's CPUs are shared.
        self._finisher = Finisher(WorkerPool(1))

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job."""
        job = from_json(VideoJob, arguments)
        result = RenderedVideos(directory=job.directory)
        if self._finisher.add(job):
            _, result = self._finisher.do_next()
        return to_json(result)

    def close(self) -> None:
        """End the process that draws."""
        self._finisher.close()

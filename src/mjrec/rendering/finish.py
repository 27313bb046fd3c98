# SPDX-License-Identifier: Apache-2.0
"""Functions that finish all recordings in a directory that have ended.

Closing, rendering, recovering and resuming all run this operation or parts of it. The
operation finishes each recording (during a simulation, the background process does that
for its monitor), updates manifests and second names, and finishes dead monitors
(`recover` and `resume=True` do everything except drawing). It can be repeated after an
interrupt or a kill, and run by any number of processes on one directory.

With an engine, the process that submits the jobs opens no trajectory and draws nothing.
If it is killed, its workers' finished videos are kept. The workers' settings may be
`{"models": [sha256, ...]}`: compiled models that the submitting user has stored, which
the workers may load. The result of a job is a `RenderedVideos`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.jobs import JobOutcome, Run, Work
from ..errors import DirectoryNotWritable, FileNotWritten
from ..formats.json_fields import from_json, to_json
from ..formats.second_names import give_all_second_names
from ..formats.spans import log_paths, remove_if_done
from ..results.manifest_writing import update_manifests
from ..simulation.model_trust import TRUST_VARIABLE, note_models, stored_models
from .finisher import Finisher, note_failure
from .jobs import Progress, RecordingKey, RenderedVideos, VideoJob
from .pool import WorkerPool
from .recordings import may_be_left, recordings
from .recovery import recover

_WORKER = "mjrec.rendering.finish:VideoWorker"
_RASTERIZER_THREADS = "LP_NUM_THREADS"

_OnProgress = Callable[[Progress], object]


def finish(
    directory: Path,
    keys: Iterable[RecordingKey] | None = None,
    *,
    workers: int | None = None,
    engine: Executor | None = None,
    strict: bool = False,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[RenderedVideos]:
    """Finish the pending recordings in a directory, and yield the result of each.

    Recordings that need no work yield no result. Recordings that another process is
    working on are left to that process.

    Args:
        directory: the monitor directory.
        keys: the recordings to finish. None means all, including the files that killed
            monitors left behind.
        workers: see `do_jobs`.
        engine: see `do_jobs`.
        strict: whether a blank video is a failure.
        on_progress: see `do_jobs`.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    has_failed = False
    wanted = recordings(directory) if keys is None else keys
    jobs = [
        VideoJob(directory=directory, recording=key.shown_name, strict=strict)
        for key in wanted
    ]
    for result in do_jobs(
        jobs, directory, workers=workers, engine=engine, on_progress=on_progress
    ):
        has_failed = has_failed or bool(result.failures)
        yield result
    try:
        bring_up_to_date(directory)
    except FileNotWritten:
        # If the disk is full, a failure has already been reported. The next run writes
        # the manifest.
        if not has_failed:
            raise
        return
    if keys is None:
        for file in recover(directory).failures:
            yield RenderedVideos(directory=directory, failures={file.name: file.what})


def bring_up_to_date(directory: Path) -> None:
    """Give videos their second names, update manifests, and remove idle logs.

    Call this after videos in a directory have been finished. It also completes what an
    earlier run left undone.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    give_all_second_names(directory)
    for log in log_paths(directory):
        # A process may have died after finishing the last recording of a log, before
        # removing the log.
        with contextlib.suppress(DirectoryNotWritable):
            remove_if_done(log)
    update_manifests(directory)


def do_jobs(
    jobs: Iterable[VideoJob],
    directory: Path,
    *,
    workers: int | None,
    engine: Executor | None = None,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[RenderedVideos]:
    """Do jobs and yield the result of each, except where there was nothing to do.

    With an engine, results are yielded in the order in which the jobs end.

    Args:
        jobs: the jobs to do. All workers of an engine must see their directories.
        directory: the directory whose CPU locks are used if `workers` is None.
        workers: number of processes that draw. None means one for each free CPU.
        engine: an engine whose workers do the work instead of this process.
        on_progress: called after every frame and at the end of every job; with an
            engine, only at the end of every job.

    Raises:
        Error: the engine cannot work.
    """
    if engine is not None:
        yield from _done_on_engine(engine, jobs, on_progress)
        return
    pool = WorkerPool(workers, directory=directory)
    with contextlib.closing(Finisher(pool, on_progress=on_progress)) as finisher:
        for job in jobs:
            finisher.add(job)
        while finisher:
            _, result = finisher.do_next()
            if not result.is_empty:
                yield result


def _done_on_engine(
    engine: Executor, jobs: Iterable[VideoJob], on_progress: _OnProgress
) -> Iterator[RenderedVideos]:
    by_name = {
        # Full paths, because files in different directories may share a name.
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
        # Workers on other machines may lack this user's list of stored models.
        settings={"models": stored_models(directories)},
        environ=environ_for_drawing(),
        shared_directory=directories[0].absolute(),
    )
    with Run(engine, work) as run:
        for name, job in by_name.items():
            # Workers may have a different working directory.
            video = None if job.video is None else job.video.absolute()
            sent = replace(job, directory=job.directory.absolute(), video=video)
            run.submit(name, **to_json(sent))
        for done in run.results():
            # Without a timeout, `done` is never None.
            assert done is not None
            result = _result_of(done, by_name[done.key])
            # The job was counted as one video.
            videos = len(result.videos) or bool(result.failures or result.elsewhere)
            now = Progress(
                videos=now.videos + videos - 1,
                videos_done=now.videos_done + videos,
                frames_done=now.frames_done + sum(result.videos.values()),
                frames=None,
            )
            on_progress(now)
            if not result.is_empty:
                yield result


def _result_of(done: JobOutcome, job: VideoJob) -> RenderedVideos:
    """Return the result of a job from its outcome on an engine."""
    if done.failure is None:
        assert done.value is not None
        # Use the path under which this process knows the directory.
        result = from_json(RenderedVideos, done.value)
        return replace(result, directory=job.video_directory)
    if job.variant is None:
        # The worker died, so it could not note the failure itself.
        note_failure(job.directory, job.shown_name, done.failure)
    failures = {job.shown_name: done.failure}
    return RenderedVideos(directory=job.video_directory, failures=failures)


def environ_for_drawing() -> dict[str, str]:
    """Return environment variables for workers that draw, on any machine."""
    # In each worker, Mesa's rasterizer would start one thread per CPU.
    environ = {_RASTERIZER_THREADS: os.environ.get(_RASTERIZER_THREADS, "0")}
    if TRUST_VARIABLE in os.environ:
        # Workers on other machines do not inherit this variable from this process.
        environ[TRUST_VARIABLE] = os.environ[TRUST_VARIABLE]
    return environ


class VideoWorker:
    """A handler for `engines.jobs` that does one render job after another.

    A child process draws. It is reused for all jobs.

    Args:
        settings: see the module docstring.
    """

    def __init__(self, settings: Mapping[str, Any] | None = None) -> None:
        note_models((settings or {}).get("models", ()))
        # With a fixed number of workers, the CPUs are not shared with other processes.
        self._finisher = Finisher(WorkerPool(1))

    def __call__(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Do a job, and return its result."""
        job = from_json(VideoJob, arguments)
        result = RenderedVideos(directory=job.directory)
        if self._finisher.add(job):
            _, result = self._finisher.do_next()
        return to_json(result)

    def close(self) -> None:
        """End the process that draws."""
        self._finisher.close()

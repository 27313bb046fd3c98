# SPDX-License-Identifier: Apache-2.0
"""Doing what is left of recordings: the trajectory's final form, and the videos.

One recording after the other, each by all workers. What cannot be done is reported,
stays as it was, and stops nothing else.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from ..errors import (
    Error,
    GLError,
    InvalidArgument,
)
from ..formats import video_metadata
from ..formats.spans import remove_if_done
from ..formats.trajectory_file import finish_trajectory
from .jobs import Progress, RenderedVideos, VideoJob, key_of
from .pool import WorkerPool
from .recorded_facts import further_video_paths, video_facts
from .recordings import (
    Plan,
    claim,
    look_at,
    read_recording,
    remove_unfinished,
)
from .render_video import render_video

logger = logging.getLogger(__name__)

_OnProgress = Callable[[Progress], object]


def do_jobs(
    jobs: Iterable[VideoJob],
    directory: Path,
    *,
    workers: int | None,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[RenderedVideos]:
    """Do jobs with workers of this process, and yield the result of each.

    Args:
        jobs: which.
        directory: whose CPUs are shared, where `workers` is None.
        workers: how many processes draw; None is one for each free CPU.
        on_progress: called after every frame, and when a job is over.
    """
    pool = WorkerPool(workers, directory=directory)
    with contextlib.closing(Finisher(pool, on_progress=on_progress)) as finisher:
        for job in jobs:
            finisher.add(job)
        while finisher:
            _, result = finisher.do_next()
            if not result.is_empty:
                yield result


def note_failure(directory: Path, name: str, reason: str) -> None:
    """Let the manifest say why a video is still pending.

    Args:
        directory: the monitor directory.
        name: of the video, or of a clip's first part; nothing is said of other files.
        reason: why.
    """
    key = key_of(name)
    if name.endswith(".mp4") or (key is not None and key.is_clip):
        video_metadata.note_failure(directory / name, reason)


class Finisher:
    """Does the jobs that are added to it, in their order, with one pool of workers.

    Args:
        pool: of the workers; closed with it.
        on_progress: as of `do_jobs`. It may add jobs.

    Attributes:
        progress: how far it is.
        on_progress: as given.
    """

    def __init__(
        self, pool: WorkerPool, *, on_progress: _OnProgress = lambda _: None
    ) -> None:
        self.progress = Progress(frames=0)
        self.on_progress = on_progress
        self._pool = pool
        # None where a job cannot be planned: its turn says why.
        self._waiting: dict[str, tuple[VideoJob, Plan | None]] = {}
        self._gl_failure: GLError | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def close(self) -> None:
        """End the workers. Idempotent."""
        self._pool.close()

    def add(self, job: VideoJob) -> bool:
        """Add a job, and return whether there is anything to do."""
        plan: Plan | None = None
        with contextlib.suppress(Error, OSError):
            plan = _plan(job)
            if plan is None:
                return False
        self._waiting[job.name] = job, plan
        videos, frames = _work(plan)
        if videos:
            self._count(videos=videos, frames=frames)
            self.start_workers()
        return True

    def is_ready(self) -> bool:
        """Return whether the model of the next job is there."""
        _, plan = next(iter(self._waiting.values()))
        return plan is None or plan.has_model

    def do_next(self) -> tuple[VideoJob, RenderedVideos]:
        """Do the first job."""
        job, plan = self._waiting.pop(next(iter(self._waiting)))
        before, (videos, frames) = self.progress.frames_done, _work(plan)
        result = self._do(job)
        if videos:
            # Also the frames that were not drawn: they are not waited for any more.
            self.progress = replace(self.progress, frames_done=before + frames)
            self._count(videos_done=videos)
        return job, result

    def start_workers(self) -> None:
        """Start the workers: soon there is a video to draw. Idempotent."""
        # What stands in the way is reported when the video is drawn.
        with contextlib.suppress(Error):
            self._pool.start()

    def prepare(self, recording: Path) -> None:
        """Let the workers load what a recording will be drawn with, once it is there.

        It may be running still.
        """
        self._pool.prepare(recording)

    def rest(self) -> None:
        """Let others use the CPUs: there is nothing to do."""
        self._pool.rest()

    def _count(self, **more: int) -> None:
        now = {name: getattr(self.progress, name) + more[name] for name in more}
        self.progress = replace(self.progress, **now)
        self.on_progress(self.progress)

    def _do(self, job: VideoJob) -> RenderedVideos:
        if job.video is None:
            nothing, name = RenderedVideos(directory=job.directory), job.key.shown_name
        else:
            nothing, name = RenderedVideos(directory=job.video.parent), job.video.name
        try:
            if job.variant is not None:
                plan = _plan(job)
                assert plan is not None
                return self._render(job, plan)
            lock = claim(job.directory, job.key)
            if lock is None:
                return replace(nothing, elsewhere=(name,))
            try:
                # Another process may have done it since it was added.
                plan = look_at(job.directory, job.key)
                if plan is None:
                    return nothing
                name = plan.videos[0].name if plan.videos else name
                return self._finish(job, plan)
            finally:
                lock.release()
        except (Error, OSError) as error:
            reason = str(error)
        except Exception as error:
            logger.exception("%s cannot be rendered.", job.recording)
            reason = f"{type(error).__name__}: {error}"
        if job.variant is None:
            note_failure(job.directory, name, reason)
        return replace(nothing, failures={name: reason})

    def _finish(self, job: VideoJob, plan: Plan) -> RenderedVideos:
        if plan.logs and plan.is_kept:
            finish_trajectory(plan.parts[0])
        result = RenderedVideos(
            directory=job.directory, trajectories=(plan.parts[0].name,)
        )
        if plan.videos:
            for video in plan.videos:
                remove_unfinished(video)
            result = self._render(job, plan)
        if not plan.is_kept:
            for part in plan.parts:
                part.unlink(missing_ok=True)
            for log in plan.logs:
                remove_if_done(log)
        return result

    def _render(self, job: VideoJob, plan: Plan) -> RenderedVideos:
        if self._gl_failure is not None:
            # The same for all of them, after a second of trying each.
            raise self._gl_failure
        try:
            return render_video(
                plan.parts,
                job.variant,
                workers=self._pool,
                out=job.video,
                strict=job.strict,
                on_frame=lambda: self._count(frames_done=1),
            )
        except GLError as error:
            self._gl_failure = error
            raise


def _plan(job: VideoJob) -> Plan | None:
    """Return what a job is; None where nothing is to be done.

    Raises:
        InvalidArgument: a video would replace one of a further camera.
        Error: the recording cannot be read.
    """
    if job.variant is None:
        return look_at(job.directory, job.key)
    assert job.video is not None
    trajectory = job.directory / job.recording
    recorded = read_recording([trajectory])
    facts, originals = recorded.facts[0], []
    if video_facts(facts) and job.video.parent.resolve() == job.directory.resolve():
        originals = [path.name for path in further_video_paths(trajectory, facts)]
    if job.video.with_suffix(".mp4").name in originals:
        raise InvalidArgument(
            f"{job.video.name} is a recorded video: this camera was recorded too. If "
            "it is not there yet, render what is pending; else say what is to be other "
            "besides the camera, or where to write it."
        )
    frames = len(recorded.chosen(job.variant.max_fps).indices)
    return Plan(parts=(trajectory,), videos=(job.video,), frame_count=frames)


def _work(plan: Plan | None) -> tuple[int, int]:
    """Return how many videos and frames a job is, as far as is known."""
    return (1, 0) if plan is None else (len(plan.videos), plan.frame_count)

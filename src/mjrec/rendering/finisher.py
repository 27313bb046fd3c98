# SPDX-License-Identifier: Apache-2.0
"""The finisher, which writes the final trajectory files and the videos.

Recordings are finished one after another, each by all workers. A failure is reported,
but leaves its recording unchanged and does not affect the other recordings.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..errors import Error, GLError, InvalidArgument
from ..formats import video_metadata
from ..formats.spans import remove_if_done
from ..formats.trajectory_file import finish_trajectory
from .jobs import Progress, RenderedVideos, VideoJob, key_of
from .pool import WorkerPool
from .recorded_facts import further_video_paths, video_facts
from .recordings import Plan, claim, look_at, read_recording, remove_unfinished
from .render_video import render_video

logger = logging.getLogger(__name__)

_OnProgress = Callable[[Progress], object]


def note_failure(directory: Path, name: str, reason: str) -> None:
    """Note for the manifest why a video is still pending.

    Args:
        directory: the monitor directory.
        name: the name of the video, or of a clip's first part. Other files are
            ignored.
        reason: the reason.
    """
    key = key_of(name)
    if name.endswith(".mp4") or (key is not None and key.is_clip):
        video_metadata.note_failure(directory / name, reason)


class Finisher:
    """Runs the jobs added to it, in order, with one worker pool.

    Args:
        pool: the worker pool; `close` closes it.
        on_progress: called after every frame, and when a job has ended. It may add
            jobs.

    Attributes:
        pool: the worker pool.
        progress: the progress so far.
        on_progress: the argument `on_progress`. It may be replaced.
    """

    def __init__(
        self, pool: WorkerPool, *, on_progress: _OnProgress = lambda _: None
    ) -> None:
        self.progress = Progress(frames=0)
        self.on_progress = on_progress
        self.pool = pool
        self._waiting: dict[str, tuple[VideoJob, Plan]] = {}
        self._gl_failure: GLError | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def close(self) -> None:
        """End the workers. Idempotent."""
        self.pool.close()

    def add(self, job: VideoJob) -> bool:
        """Add a job, and return whether there is anything to do."""
        try:
            plan = _plan(job)
        except (Error, OSError):
            # `do_next` reports the reason. Until then, the job counts as one video.
            plan = Plan(parts=(), videos=(Path(job.shown_name),), frame_count=0)
        if plan is None:
            return False
        self._waiting[job.name] = job, plan
        if plan.videos:
            self._count(videos=len(plan.videos), frames=plan.frame_count)
            self.pool.start()
        return True

    def is_ready(self) -> bool:
        """Return whether the model of the next job exists."""
        _, plan = next(iter(self._waiting.values()))
        # A running simulation may still be writing the file.
        return plan.model_file is None or plan.model_file.exists()

    def do_next(self) -> tuple[VideoJob, RenderedVideos]:
        """Do the next job, and return it with its result."""
        job, plan = self._waiting.pop(next(iter(self._waiting)))
        # Also count the frames that will never be drawn.
        frames_done = self.progress.frames_done + plan.frame_count
        result = self._do(job)
        if plan.videos:
            self.progress = replace(self.progress, frames_done=frames_done)
            self._count(videos_done=len(plan.videos))
        return job, result

    def _count(self, **more: int) -> None:
        now = {name: getattr(self.progress, name) + more[name] for name in more}
        self.progress = replace(self.progress, **now)
        self.on_progress(self.progress)

    def _do(self, job: VideoJob) -> RenderedVideos:
        nothing = RenderedVideos(directory=job.video_directory)
        name = job.shown_name
        try:
            if job.variant is not None:
                plan = _plan(job)
                assert plan is not None
                return self._render(job, plan)
            lock = claim(job.directory, job.key)
            if lock is None:
                return replace(nothing, elsewhere=(name,))
            try:
                # Another process may have finished the recording since then.
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
            logger.exception("%s could not be rendered.", job.recording)
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
            # Every other job would fail in the same way, after trying for a second.
            raise self._gl_failure
        try:
            return render_video(
                plan.parts,
                job.variant,
                workers=self.pool,
                out=job.video,
                strict=job.strict,
                on_frame=lambda: self._count(frames_done=1),
            )
        except GLError as error:
            self._gl_failure = error
            raise


def _plan(job: VideoJob) -> Plan | None:
    """Return the plan for a job; None if there is nothing to do.

    Raises:
        InvalidArgument: the video would replace a recorded video from another camera.
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
            "the video is missing, render the pending videos. Otherwise, change more "
            "than the camera, or specify where to write the file."
        )
    frames = len(recorded.chosen(job.variant.max_fps).indices)
    return Plan(parts=(trajectory,), videos=(job.video,), frame_count=frames)

# SPDX-License-Identifier: Apache-2.0
"""Finishing recordings: the trajectory's final form, the videos, the manifest.

One recording after the other, each by all workers. What cannot be done is told, stays
as it was, and stops nothing else.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from ..errors import (
    BlankVideo,
    DirectoryNotWritable,
    Error,
    FileNotWritten,
    GLError,
    InvalidArgument,
)
from ..formats import render_failures
from ..formats.second_names import give_all_second_names
from ..formats.spans import drop_recording, list_paths, remove_if_done
from ..formats.trajectory_file import finish_trajectory
from ..results.manifest_and_stats import update_manifests
from .jobs import Outcome, VideoJob
from .progress import Progress
from .recorded_facts import further_video_paths, video_facts
from .recordings import (
    PendingRecording,
    RecordingKey,
    claim,
    key_of,
    look_at,
    read_recording,
    recordings,
    remove_unfinished,
)
from .render_video import render_video
from .shared_pool import SharedPool

logger = logging.getLogger(__name__)

_OnProgress = Callable[[Progress], object]


class _Work(NamedTuple):
    """How much a job is, and which file of a model has to be there for it."""

    videos: int
    frames: int
    model_file: Path | None = None

    @property
    def has_model(self) -> bool:
        return self.model_file is None or self.model_file.exists()


def finish(
    directory: Path,
    keys: Iterable[RecordingKey] | None = None,
    *,
    workers: int | None,
    strict: bool = False,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[Outcome]:
    """Finish what is pending in a directory, and yield what became of each recording.

    Nothing is yielded of one that nothing was to be done about. What another
    process is at is left to it. Manifests of monitors that are closed are kept true,
    and second names of videos are given, also where an earlier run could not.

    Args:
        directory: the monitor directory.
        keys: which recordings; all, if None.
        workers: how many processes draw; None is one for each free CPU.
        strict: whether a video that shows nothing is a failure.
        on_progress: called after every frame, and when a recording is over.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    wanted = recordings(directory) if keys is None else keys
    jobs = [VideoJob.finishing(directory, key, strict=strict) for key in wanted]
    has_failed = False
    for outcome in do_jobs(jobs, directory, workers=workers, on_progress=on_progress):
        has_failed = has_failed or outcome.failure is not None
        yield outcome
    try:
        bring_up_to_date(directory)
    except FileNotWritten:
        # On a full disk, what failed has said so; the manifest comes with the next try.
        if not has_failed:
            raise


def do_jobs(
    jobs: Iterable[VideoJob],
    directory: Path,
    *,
    workers: int | None,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[Outcome]:
    """Do jobs with workers of this process, and yield what became of each.

    Args:
        jobs: which.
        directory: whose CPUs are shared, where `workers` is None.
        workers: as of `finish`.
        on_progress: likewise.
    """
    with Finisher(directory, workers=workers, on_progress=on_progress) as finisher:
        for job in jobs:
            finisher.add(job)
        while finisher:
            _, outcome = finisher.do_next()
            yield outcome


def bring_up_to_date(directory: Path) -> None:
    """Give videos their second names, keep manifests true, and remove idle logs.

    To be called when videos of a directory have been finished. It also does what an
    earlier run could not.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    give_all_second_names(directory)
    for spans in list(list_paths(directory)):
        # Those of a process that died between finishing the last and removing them.
        with contextlib.suppress(DirectoryNotWritable):
            remove_if_done(spans)
    update_manifests(directory)


def note_failure(directory: Path, name: str, reason: str) -> None:
    """Let the manifest say why a video is still pending.

    Args:
        directory: the monitor directory.
        name: of the video, or of a clip's first part; nothing is said of other files.
        reason: why.
    """
    key = key_of(name)
    if name.endswith(".mp4") or (key is not None and key.is_clip):
        render_failures.note_failure(directory / name, reason)


class Finisher:
    """Does the jobs that are added to it, with one pool of workers.

    Args:
        directory: whose CPUs are shared.
        workers: how many processes draw; None is one for each free CPU.
        on_progress: see below.

    Attributes:
        progress: how far it is.
        on_progress: called after every frame, and when a job is done. It may add jobs.
    """

    def __init__(
        self,
        directory: Path,
        *,
        workers: int | None,
        on_progress: _OnProgress = lambda _: None,
    ) -> None:
        self.progress = Progress()
        self.on_progress = on_progress
        self._pool = SharedPool(directory, workers=workers)
        self._waiting: dict[str, tuple[VideoJob, _Work]] = {}
        self._gl_failure: GLError | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the workers. Idempotent."""
        self._pool.close()

    def add(self, job: VideoJob) -> bool:
        """Add a job, and return whether there is anything to do."""
        try:
            work = _work_of(job)
        except (Error, OSError):
            # The same again when its turn comes, which is when it is told.
            work = _Work(1, 0)
        if work is None:
            return False
        self._waiting[job.name] = job, work
        if work.videos:
            self._count(videos=work.videos, frames=work.frames)
            self.start_workers()
        return True

    def is_ready(self) -> bool:
        """Tell whether a job waits whose model is there already."""
        return any(work.has_model for _, work in self._waiting.values())

    def do_next(self) -> tuple[VideoJob, Outcome]:
        """Do the first job whose model is there, else the first."""
        waiting = self._waiting.values()
        ready = (job for job, work in waiting if work.has_model)
        job, work = self._waiting.pop(next(ready, next(iter(waiting))[0]).name)
        before = self.progress
        outcome = self._do(job)
        if work.videos:
            # Also the frames that were not drawn: nobody waits for them any more.
            frames_done = before.frames_done + work.frames
            self.progress = replace(self.progress, frames_done=frames_done)
            self._count(videos_done=work.videos)
        return job, outcome

    def start_workers(self) -> None:
        """Start the workers: soon there is a video to draw. Idempotent."""
        # What stands in the way is told when the video is drawn.
        with contextlib.suppress(Error):
            self._pool.start()

    def rest(self) -> None:
        """Let others use the CPUs: there is nothing to do."""
        self._pool.rest()

    def _count(self, **more: int) -> None:
        now = {name: getattr(self.progress, name) + more[name] for name in more}
        self.progress = replace(self.progress, **now)
        self.on_progress(self.progress)

    def _do(self, job: VideoJob) -> Outcome:
        outcome = job.nothing
        try:
            if job.variant is not None:
                _check_is_no_original(job)
                return self._render(outcome, job, [job.directory / job.recording])
            lock = claim(job.directory, job.key)
            if lock is None:
                return replace(outcome, is_elsewhere=True)
            try:
                # Another process may have done it since it was added.
                pending = look_at(job.directory, job.key)
                if pending is None:
                    return outcome
                if pending.video is not None:
                    outcome = replace(outcome, name=pending.video.name)
                return self._finish(job, pending)
            finally:
                lock.release()
        except (Error, OSError) as error:
            reason = str(error)
        except Exception as error:
            logger.exception("%s cannot be rendered.", job.recording)
            reason = f"{type(error).__name__}: {error}"
        if job.variant is None:
            note_failure(job.directory, outcome.name, reason)
        return replace(outcome, failure=reason)

    def _finish(self, job: VideoJob, pending: PendingRecording) -> Outcome:
        if pending.is_log and pending.is_kept:
            finish_trajectory(pending.parts[0])
        outcome = replace(job.nothing, name=pending.parts[0].name)
        if pending.video is not None:
            further = tuple(video.name for video in pending.further_videos)
            for video in (pending.video, *pending.further_videos):
                remove_unfinished(video)
            outcome = replace(outcome, name=pending.video.name)
            outcome = self._render(outcome, job, pending.parts)
            if outcome.is_video:
                outcome = replace(outcome, further_videos=further)
        if not pending.is_kept:
            # The first one last: it says which video they are of.
            for part in reversed(pending.parts):
                part.unlink(missing_ok=True)
                drop_recording(part)
        return outcome

    def _render(
        self, outcome: Outcome, job: VideoJob, parts: Sequence[Path]
    ) -> Outcome:
        """Render the videos of a recording, and return what became of them."""
        if self._gl_failure is not None:
            # The same for all of them, after a second of trying each.
            raise self._gl_failure
        try:
            file = render_video(
                parts,
                job.variant,
                workers=self._pool.at_work(),
                out=job.video,
                strict=job.strict,
                on_frame=lambda: self._count(frames_done=1),
            )
        except GLError as error:
            self._gl_failure = error
            raise
        except BlankVideo as error:
            # It is as much of a video as there will ever be.
            return replace(
                outcome,
                is_video=True,
                frame_count=error.frame_count,
                failure=str(error),
                blank_video=error.path.name,
            )
        frame_count = 0 if file is None else file.frame_count
        return replace(outcome, is_video=frame_count > 0, frame_count=frame_count)


def _work_of(job: VideoJob) -> _Work | None:
    """Return how much a job is; None where nothing is to be done."""
    if job.variant is not None:
        recorded = read_recording([job.directory / job.recording])
        return _Work(1, len(recorded.chosen(job.variant.max_fps).indices))
    pending = look_at(job.directory, job.key)
    if pending is None:
        return None
    videos = int(pending.video is not None) + len(pending.further_videos)
    return _Work(videos, pending.frame_count, pending.model_file)


def _check_is_no_original(job: VideoJob) -> None:
    """Raise InvalidArgument if a video would replace one of a further camera."""
    assert job.video is not None
    if job.video.parent.resolve() != job.directory.resolve():
        return
    trajectory = job.directory / job.recording
    facts = read_recording([trajectory]).facts[0]
    originals = further_video_paths(trajectory, facts) if video_facts(facts) else []
    if job.video.with_suffix(".mp4").name in {path.name for path in originals}:
        raise InvalidArgument(
            f"{job.video.name} is a recorded video: this camera was recorded too. If "
            "it is not there yet, render what is pending; else say what is to be other "
            "besides the camera, or where to write it."
        )

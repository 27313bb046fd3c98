# SPDX-License-Identifier: Apache-2.0
"""Finishing recordings: the trajectory's final form, the video, the manifest.

One episode or clip after the other, each by all workers. What cannot be done is told,
stays as it was, and stops nothing else.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from ..errors import (
    BlankVideo,
    DirectoryNotWritable,
    Error,
    FileNotWritten,
    GLError,
)
from ..formats.in_flight import drop_recording, list_paths, remove_if_done
from ..formats.pending_videos import forget_failure
from ..formats.pending_videos import note_failure as note_failure_of
from ..formats.second_names import give_all_second_names
from ..formats.trajectory_file import finish_trajectory
from ..formats.unfinished_video import VideoFile
from ..results.listing import write_listings
from .clip_videos import render_clip
from .outcomes import Outcome
from .pending import (
    PendingEpisode,
    PendingRecording,
    RecordingKey,
    claim,
    look_at,
    remove_unfinished,
)
from .pool import WorkerPool
from .progress import Progress
from .recorded_clips import ClipKey, PendingClip
from .shared_pool import SharedPool
from .videos import render_video

logger = logging.getLogger(__name__)


class _Render(Protocol):
    """Renders the videos of one recording."""

    def __call__(
        self,
        *,
        workers: WorkerPool,
        strict: bool,
        on_frame: Callable[[], object],
    ) -> VideoFile | None: ...


def finish_pending(
    directory: Path,
    keys: Iterable[RecordingKey],
    *,
    workers: int | None,
    strict: bool = False,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[Outcome]:
    """Finish what is pending of some recordings, and yield what became of each.

    Nothing is yielded of one that nothing was to be done about. What another
    process is at is left to it. Manifests of monitors that are closed are kept true,
    and second names of videos are given, also where an earlier run could not.

    Args:
        directory: the monitor directory.
        keys: which episodes and clips.
        workers: how many processes draw; None is one for each free CPU.
        strict: whether a video that shows nothing is a failure.
        on_progress: called after every frame, and when an episode is over.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    with EpisodeFinisher(
        directory, workers=workers, strict=strict, on_progress=on_progress
    ) as finisher:
        for key in keys:
            finisher.add(key)
        has_failed = False
        while finisher:
            _, outcome = finisher.finish_next()
            has_failed = has_failed or outcome.failure is not None
            yield outcome
    try:
        bring_up_to_date(directory)
    except FileNotWritten:
        # On a full disk, what failed has said so; the manifest comes with the next try.
        if not has_failed:
            raise


def bring_up_to_date(directory: Path) -> None:
    """Give videos their second names, keep manifests true, and remove idle logs.

    To be called when videos of a directory have been finished. It also does what an
    earlier run could not.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    give_all_second_names(directory)
    for spans in list(list_paths(directory)):
        # Those of whoever died between finishing the last recording and removing them.
        with contextlib.suppress(DirectoryNotWritable):
            remove_if_done(spans)
    write_listings(directory)


def note_failure(directory: Path, name: str, reason: str) -> None:
    """Let the manifest say why a video is still pending.

    Args:
        directory: the monitor directory.
        name: of the video, or of a clip's first part; nothing is said of other files.
        reason: why.
    """
    if name.endswith(".mp4") or ClipKey.of(name) is not None:
        note_failure_of(directory / name, reason)


class EpisodeFinisher:
    """Finishes the episodes and clips that are added to it.

    Args:
        directory: the monitor directory.
        workers: how many processes draw; None is one for each free CPU.
        strict: whether a video that shows nothing is a failure, though it is there.
        on_progress: see below.
        wait: called with seconds to wait while no CPU is free.

    Attributes:
        progress: how far it is.
        on_progress: called after every frame, and when a recording is done. It may add
            recordings.
    """

    def __init__(
        self,
        directory: Path,
        *,
        workers: int | None,
        strict: bool = False,
        on_progress: Callable[[Progress], object] = lambda _: None,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self.progress = Progress()
        self.on_progress = on_progress
        self._directory = directory
        self._strict = strict
        self._pool = SharedPool(directory, workers=workers, wait=wait)
        # None stands for one that could not be read when it was added.
        self._waiting: dict[RecordingKey, PendingRecording | None] = {}
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
        self._pool.close()

    def add(self, key: RecordingKey) -> bool:
        """Add a recording, and return whether there is anything to do about it."""
        try:
            pending = look_at(self._directory, key)
        except (Error, OSError):
            # The same again when its turn comes, which is when it is told.
            pending = None
        else:
            if pending is None:
                return False
        self._waiting[key] = pending
        videos, frames = _work(pending)
        if videos:
            self._count(videos=videos, frames=frames)
            self.start_workers()
        return True

    def is_ready(self) -> bool:
        """Tell whether a recording waits whose model is there already."""
        return any(map(_has_model, self._waiting.values()))

    def finish_next(self) -> tuple[RecordingKey, Outcome]:
        """Finish the first recording whose model is there, else the first."""
        key = next(
            (key for key, pending in self._waiting.items() if _has_model(pending)),
            next(iter(self._waiting)),
        )
        pending = self._waiting.pop(key)
        before = self.progress
        outcome = self._finish(key)
        videos, frames = _work(pending)
        if videos:
            # Also the frames that were not drawn: nobody waits for them any more.
            self.progress = replace(
                self.progress, frames_done=before.frames_done + frames
            )
            self._count(videos_done=videos)
        return key, outcome

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

    def _finish(self, key: RecordingKey) -> Outcome:
        nothing = Outcome(name=key.told_name, directory=self._directory)
        try:
            lock = claim(self._directory, key)
            if lock is None:
                return replace(nothing, is_elsewhere=True)
            try:
                # Somebody else may have done it since it was added.
                pending = look_at(self._directory, key)
                if pending is None:
                    return nothing
                if pending.video is not None:
                    nothing = replace(nothing, name=pending.video.name)
                if isinstance(pending, PendingClip):
                    return self._finish_clip(pending)
                return self._finish_episode(pending)
            finally:
                lock.release()
        except (Error, OSError) as error:
            reason = str(error)
        except Exception as error:
            logger.exception("%s cannot be finished.", key.recording_name)
            reason = f"{type(error).__name__}: {error}"
        note_failure(self._directory, nothing.name, reason)
        return replace(nothing, failure=reason)

    def _finish_clip(self, clip: PendingClip) -> Outcome:
        outcome = Outcome(name=clip.parts[0].name, directory=self._directory)
        if clip.video is not None:
            outcome = self._finish_videos(
                clip,
                replace(outcome, name=clip.video.name),
                functools.partial(render_clip, clip.parts),
            )
        # The first one last: it says which video they are of.
        for part in reversed(clip.parts):
            drop_recording(part)
        return outcome

    def _finish_episode(self, episode: PendingEpisode) -> Outcome:
        path = episode.trajectory
        if episode.is_log and episode.is_kept:
            path = finish_trajectory(path)
        outcome = Outcome(name=path.name, directory=self._directory)
        if episode.video is not None:
            outcome = self._finish_videos(
                episode,
                replace(outcome, name=episode.video.name),
                functools.partial(render_video, path),
            )
        if not episode.is_kept:
            path.unlink(missing_ok=True)
            drop_recording(path)
        return outcome

    def _finish_videos(
        self, pending: PendingRecording, outcome: Outcome, render: _Render
    ) -> Outcome:
        """Render the videos of a recording, and return what became of them."""
        assert pending.video is not None
        for video in (pending.video, *pending.further_videos):
            remove_unfinished(video)
        outcome = self._rendered(outcome, render)
        forget_failure(pending.video)
        if not outcome.is_video:
            return outcome
        names = tuple(video.name for video in pending.further_videos)
        return replace(outcome, further_videos=names)

    def _rendered(self, outcome: Outcome, render: _Render) -> Outcome:
        try:
            file = self._render(render)
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

    def _render(self, render: _Render) -> VideoFile | None:
        if self._gl_failure is not None:
            # The same for all of them, after a second of trying each.
            raise self._gl_failure
        try:
            return render(
                workers=self._pool.at_work(),
                strict=self._strict,
                on_frame=lambda: self._count(frames_done=1),
            )
        except GLError as error:
            self._gl_failure = error
            raise


def _work(pending: PendingRecording | None) -> tuple[int, int]:
    """Return how many videos and frames it is; one that is not known is one."""
    return (1, 0) if pending is None else (pending.video_count, pending.frame_count)


def _has_model(pending: PendingRecording | None) -> bool:
    file = None if pending is None else pending.model_file
    return file is None or file.exists()

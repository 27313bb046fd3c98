# SPDX-License-Identifier: Apache-2.0
"""Finishing episodes: the trajectory's final form, the video, the manifest.

One episode after the other, each by all workers. What cannot be done is told, stays
as it was, and stops nothing else.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from ..errors import BlankVideo, Error, GLError
from ..formats.second_names import give_all_second_names
from ..formats.trajectory_file import finish_trajectory
from ..formats.video_writer import VideoFile
from .crew import Crew
from .outcomes import Outcome
from .pending import EpisodeKey, PendingEpisode, claim, look_at, remove_unfinished
from .progress import Progress
from .rendered_manifests import reconcile, update_manifest
from .videos import render_video

__all__ = ["EpisodeFinisher", "finish_pending"]

logger = logging.getLogger(__name__)


def finish_pending(
    directory: Path,
    keys: Iterable[EpisodeKey],
    *,
    workers: int | None,
    strict: bool = False,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[Outcome]:
    """Finish what is pending of some episodes, and yield what became of each.

    Nothing is yielded of an episode that nothing was to be done about. What another
    process is at is left to it. Manifests of monitors that are closed are kept true,
    and second names of videos are given, also where an earlier run could not.

    Args:
        directory: the monitor directory.
        keys: which episodes.
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
        while finisher:
            _, outcome = finisher.finish_next()
            yield outcome
    give_all_second_names(directory)
    reconcile(directory)


class EpisodeFinisher:
    """Finishes the episodes that are added to it.

    Args:
        directory: the monitor directory.
        workers: how many processes draw; None is one for each free CPU.
        strict: whether a video that shows nothing is a failure, though it is there.
        on_progress: see below.
        wait: called with seconds to wait while no CPU is free.

    Attributes:
        progress: how far it is.
        on_progress: called after every frame, and when an episode is over. It may add
            episodes.
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
        self._crew = Crew(directory, workers=workers, wait=wait)
        # None stands for one that could not be read when it was added.
        self._waiting: dict[EpisodeKey, PendingEpisode | None] = {}
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
        self._crew.close()

    def add(self, key: EpisodeKey) -> bool:
        """Add an episode, and return whether there is anything to do about it."""
        try:
            episode = look_at(self._directory, key)
        except (Error, OSError):
            # The same again when its turn comes, which is when it is told.
            episode = None
        else:
            if episode is None:
                return False
        self._waiting[key] = episode
        videos, frames = _work(episode)
        if videos:
            self._count(videos=videos, frames=frames)
        return True

    def is_ready(self) -> bool:
        """Tell whether an episode waits whose model is there already."""
        return any(map(_has_model, self._waiting.values()))

    def finish_next(self) -> tuple[EpisodeKey, Outcome]:
        """Finish the first episode whose model is there, else the first."""
        key = next(
            (key for key, episode in self._waiting.items() if _has_model(episode)),
            next(iter(self._waiting)),
        )
        episode = self._waiting.pop(key)
        before = self.progress
        outcome = self._finish(key)
        videos, frames = _work(episode)
        if videos:
            # Also the frames that were not drawn: nobody waits for them any more.
            self.progress = replace(
                self.progress, frames_done=before.frames_done + frames
            )
            self._count(videos_done=videos)
        return key, outcome

    def rest(self) -> None:
        """Let others use the CPUs: there is nothing to do."""
        self._crew.rest()

    def dismiss_workers(self) -> None:
        """End the workers, who have had nothing to do for long."""
        self._crew.dismiss()

    def _count(self, **more: int) -> None:
        now = {name: getattr(self.progress, name) + more[name] for name in more}
        self.progress = replace(self.progress, **now)
        self.on_progress(self.progress)

    def _finish(self, key: EpisodeKey) -> Outcome:
        nothing = Outcome(name=key.video_name, directory=self._directory)
        try:
            lock = claim(self._directory, key)
            if lock is None:
                return replace(nothing, is_elsewhere=True)
            try:
                # Somebody else may have done it since it was added.
                episode = look_at(self._directory, key)
                return nothing if episode is None else self._finish_claimed(episode)
            finally:
                lock.release()
        except (Error, OSError) as error:
            reason = str(error)
        except Exception as error:
            logger.exception("%s cannot be finished.", key.trajectory_name)
            reason = f"{type(error).__name__}: {error}"
        self._note_failure(key, reason)
        return replace(nothing, failure=reason)

    def _note_failure(self, key: EpisodeKey, reason: str) -> None:
        # Whatever stands in the way of that is told by `reconcile`.
        with contextlib.suppress(Error, OSError):
            update_manifest(
                self._directory, key.infix, reasons={key.video_name: reason}
            )

    def _finish_claimed(self, episode: PendingEpisode) -> Outcome:
        path = episode.trajectory
        if episode.is_log and episode.is_kept:
            path = finish_trajectory(path)
        outcome = Outcome(name=path.name, directory=self._directory)
        if episode.video is not None:
            outcome = replace(outcome, name=episode.video.name)
            for video in (episode.video, *episode.further_videos):
                remove_unfinished(video)
            outcome = self._rendered(path, outcome)
            if outcome.is_video:
                names = tuple(video.name for video in episode.further_videos)
                outcome = replace(outcome, further_videos=names)
        if not episode.is_kept:
            for suffix in (".log", ".h5"):
                path.with_suffix(suffix).unlink(missing_ok=True)
        update_manifest(self._directory, episode.key.infix)
        return outcome

    def _rendered(self, trajectory: Path, outcome: Outcome) -> Outcome:
        """Render the video of a trajectory, and return what became of it."""
        try:
            file = self._render(trajectory)
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

    def _render(self, trajectory: Path) -> VideoFile | None:
        if self._gl_failure is not None:
            # The same for all of them, after a second of trying each.
            raise self._gl_failure
        try:
            return render_video(
                trajectory,
                workers=self._crew.at_work(),
                strict=self._strict,
                on_frame=lambda: self._count(frames_done=1),
            )
        except GLError as error:
            self._gl_failure = error
            raise


def _work(episode: PendingEpisode | None) -> tuple[int, int]:
    """Return how many videos and frames an episode is; one that is not known is one."""
    return (1, 0) if episode is None else (episode.video_count, episode.frame_count)


def _has_model(episode: PendingEpisode | None) -> bool:
    file = None if episode is None else episode.model_file
    return file is None or file.exists()

# SPDX-License-Identifier: Apache-2.0
"""Experiment trackers, which are notified of finished episodes and videos.

A tracker is called in the simulation's process, between two steps, so it should return
quickly. It is given facts and file names, never frames.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..formats.monitor_directory import episode_of, view_of
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Run:
    """One monitor's recording.

    Attributes:
        directory: the monitor directory, absolute.
        infix: the middle part of its file names.
        env_id: the environment's name.
        env_index: index of a sub-environment in a vector environment. None for a single
            environment.
    """

    directory: Path
    infix: str
    env_id: str
    env_index: int | None = None


@dataclass(frozen=True, kw_only=True)
class FinishedEpisode:
    """A finished episode.

    Attributes:
        episode_id: the episode's number.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        terminated: whether the task ended the episode.
        truncated: whether a limit outside the task ended it.
        success: `info["is_success"]` or `info["success"]` of the last step; None if
            both are missing.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        start_time: wall clock just before the reset, in seconds since the epoch.
        end_time: wall clock after the last step, in seconds since the epoch.
        total_steps: number of steps of the run so far, including unfinished episodes.
    """

    episode_id: int
    length: int
    reward: float
    type: str
    terminated: bool
    truncated: bool
    success: bool | None
    seed: Any
    options: Any
    start_time: float
    end_time: float
    total_steps: int


@dataclass(frozen=True, kw_only=True)
class FinishedVideo:
    """A finished video.

    Attributes:
        path: the video file.
        metadata_path: its metadata file (JSON).
        episode_id: number of its episode, or of the episode in which it starts.
        view: the view in the file name: a further camera's name, or `tiled`; empty for
            the first camera.
        episode: its episode; None if the episode is not over or was not completed.
    """

    path: Path
    metadata_path: Path
    episode_id: int
    episode: FinishedEpisode | None
    view: str = ""


class Tracker:
    """Base class for experiment trackers, for `mjrec.Monitor(..., trackers=...)`.

    Subclass it and override methods; each does nothing by default. One tracker can
    serve several runs at once, such as those of a vector environment: each call names
    its run. If a method raises, the error is logged and noted in the manifest, the
    tracker gets no more calls for that run, and the recording continues.
    """

    def begin(self, run: Run) -> None:
        """Called when a run begins."""

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Called when an episode has ended."""

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Called when a video is finished.

        Deferred videos are finished in the background and reported at the end of the
        next episode, or in `close`.
        """

    def end(self, run: Run) -> None:
        """Called at the end of a run, as its last call."""


class Trackers:
    """The trackers of one run.

    A tracker that raises is not called again, so that a tracker that has lost its
    server does not stop the simulation.

    Args:
        run: the run that is reported to the trackers.
        trackers: the trackers.
        on_fault: called when a tracker has raised, with its class name, the error, and
            the number of the reported episode or None.
    """

    def __init__(
        self,
        run: Run,
        trackers: Iterable[Tracker],
        *,
        on_fault: Callable[[str, Exception, int | None], object],
    ) -> None:
        self._run = run
        self._trackers: Sequence[Tracker] = tuple(trackers)
        self._on_fault = on_fault
        # The first video of each episode or clip.
        self._awaited: dict[Path, None] = {}
        # Episodes whose videos may still come.
        self._episodes: dict[int, FinishedEpisode] = {}
        self._notify(None, "begin")

    def __bool__(self) -> bool:
        """Whether there are any trackers."""
        return bool(self._trackers)

    def expect(self, video: Path) -> None:
        """Watch for the first video of an episode or a clip."""
        if self._trackers:
            self._awaited[video] = None

    def episode(self, episode: FinishedEpisode, *, has_video: bool) -> None:
        """Report an episode that has just ended, and all videos finished by now.

        Args:
            episode: the episode.
            has_video: whether the episode may get a video.
        """
        if self._trackers:
            if has_video:
                self._episodes[episode.episode_id] = episode
            self._notify(episode.episode_id, "episode", episode)
            self._report_videos()

    def end(self) -> None:
        """Report the end of the run. No tracker is called after that."""
        self._report_videos()
        self._notify(None, "end")
        self._trackers = ()

    def _report_videos(self) -> None:
        # A video is done once its metadata exists, which is written last.
        done = [video for video in self._awaited if is_done(video)]
        for video in done:
            del self._awaited[video]
            if is_broken(metadata_path(video)):
                continue
            for name, about in finished_videos(video):
                number = episode_of(name) or 0
                finished = FinishedVideo(
                    path=video.with_name(name),
                    metadata_path=video.with_name(about),
                    episode_id=number,
                    episode=self._episodes.get(number),
                    view=view_of(name),
                )
                self._notify(number, "video", finished)

    def _notify(self, episode_id: int | None, what: str, *facts: Any) -> None:
        for tracker in self._trackers:
            try:
                getattr(tracker, what)(self._run, *facts)
            except Exception as error:  # a user's tracker may do anything
                name = type(tracker).__name__
                logger.exception("%s failed and will not be notified again.", name)
                others = (each for each in self._trackers if each is not tracker)
                self._trackers = tuple(others)
                self._on_fault(name, error, episode_id)
                # Give it a chance to release its resources.
                with contextlib.suppress(Exception):
                    tracker.end(self._run)

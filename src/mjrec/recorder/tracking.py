# SPDX-License-Identifier: Apache-2.0
"""Experiment trackers, which are notified of finished episodes and videos.

A tracker is called between two steps in the simulating process, so it should return
quickly. It receives facts and file names, but never frames.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..formats.monitor_directory import episode_of, view_of
from ..formats.video_metadata import finished_videos, is_broken, is_done, metadata_path

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Run:
    """One monitor's recording.

    Attributes:
        directory: absolute path of the monitor directory.
        infix: the middle part of the monitor's file names.
        env_id: the environment's name.
        env_index: index of the sub-environment in a vector environment; None for a
            single environment.
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
        truncated: whether a limit outside the task ended the episode.
        success: `info["is_success"]` or `info["success"]` from the last step; None if
            both are missing.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        start_time: time just before the reset, in seconds since the Unix epoch.
        end_time: time after the last step, in seconds since the Unix epoch.
        total_steps: number of steps in the run so far, including steps of unfinished
            episodes.
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
        path: path of the video.
        metadata_path: path of the video's metadata file (JSON).
        episode_id: number of the episode that the video shows, or in which it starts.
        view: the name of an additional camera, or `tiled`, as in the file name; empty
            for the first camera.
        episode: the episode; None if the episode has not ended or was not completed.
    """

    path: Path
    metadata_path: Path
    episode_id: int
    episode: FinishedEpisode | None
    view: str = ""


class Tracker:
    """Base class for experiment trackers, for `mjrec.Monitor(..., trackers=...)`.

    Override the methods in a subclass. By default, the methods do nothing. A tracker
    can serve several runs at the same time, such as the runs of a vector environment.
    Each call therefore includes the run. If a method raises an exception, the error is
    logged and recorded in the manifest. The tracker is then not called again for that
    run, and the recording continues.
    """

    def begin(self, run: Run) -> None:
        """Called when a run begins."""

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Called when an episode has ended."""

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Called when a video is finished.

        Deferred videos are finished in the background. They are reported at the end of
        the next episode or when the monitor closes.
        """

    def end(self, run: Run) -> None:
        """Called at the end of a run, as the last call for the run."""


class Trackers:
    """The trackers of one run.

    A tracker that raises an exception is not called again. For example, a tracker that
    loses its server does not stop the simulation.

    Args:
        run: the run to report to the trackers.
        trackers: the trackers.
        on_fault: a function that is called when a tracker has raised an exception. Its
            arguments are the tracker's class name, the error, and the number of the
            reported episode or None.
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
        # The first video of each episode or clip that is not finished yet.
        self._awaited: dict[Path, None] = {}
        # Episodes that may have unfinished videos.
        self._episodes: dict[int, FinishedEpisode] = {}
        self._notify(None, "begin")

    def __bool__(self) -> bool:
        """Whether there are any trackers."""
        return bool(self._trackers)

    def expect(self, video: Path) -> None:
        """Report the videos of an episode or clip once its first video exists."""
        if self._trackers:
            self._awaited[video] = None

    def episode(self, episode: FinishedEpisode, *, has_video: bool) -> None:
        """Report an episode that has just ended, and all newly finished videos.

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
        """Report the end of the run. No tracker is called afterwards."""
        self._report_videos()
        self._notify(None, "end")
        self._trackers = ()

    def _report_videos(self) -> None:
        # A video is finished once its metadata exists, because that is written last.
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
            except Exception as error:  # a user's tracker may raise anything
                name = type(tracker).__name__
                logger.exception("%s failed and will not be notified again.", name)
                others = (each for each in self._trackers if each is not tracker)
                self._trackers = tuple(others)
                self._on_fault(name, error, episode_id)
                # Gives the tracker a chance to release its resources.
                with contextlib.suppress(Exception):
                    tracker.end(self._run)

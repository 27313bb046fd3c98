# SPDX-License-Identifier: Apache-2.0
"""Telling trackers what happens to a run, whatever they do with it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ..formats.video_names import view_of
from .tracking import FinishedEpisode, FinishedVideo, Run, Tracker

logger = logging.getLogger(__name__)


class ToldTrackers:
    """The trackers of one run.

    One that raises is not called again: an experiment tracker that has lost its server
    is no reason to lose a simulation.

    Args:
        run: what they are told of.
        trackers: who is told.
        on_fault: called with the class name of one that has raised, what, and the
            number of the episode that it was told of, or None.
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
        # Of episodes whose videos are still to come.
        self._episodes: dict[int, FinishedEpisode] = {}
        self._tell(None, "begin")

    def __bool__(self) -> bool:
        """Whether anybody listens."""
        return bool(self._trackers)

    def episode(self, episode: FinishedEpisode, *, has_video: bool) -> None:
        """Tell of an episode that has just ended.

        Args:
            episode: the episode.
            has_video: whether a video of it may come.
        """
        if has_video and self._trackers:
            self._episodes[episode.episode_id] = episode
        self._tell(episode.episode_id, "episode", episode)

    def videos(self, finished: Iterable[tuple[int, Path, Path]]) -> None:
        """Tell of videos that are finished.

        Args:
            finished: the number of the episode, the video and its metadata.
        """
        for episode_id, path, metadata_path in finished:
            self._tell(
                episode_id,
                "video",
                FinishedVideo(
                    path=path,
                    metadata_path=metadata_path,
                    episode_id=episode_id,
                    episode=self._episodes.get(episode_id),
                    view=view_of(path.name),
                ),
            )

    def end(self) -> None:
        """Tell of the end of the run; nobody is called any more after it."""
        self._tell(None, "end")
        self._trackers = ()
        self._episodes.clear()

    def _tell(self, episode_id: int | None, what: str, *facts: Any) -> None:
        for tracker in self._trackers:
            try:
                getattr(tracker, what)(self._run, *facts)
            except Exception as error:  # whatever somebody's tracker does
                self._dismiss(tracker, error, episode_id)

    def _dismiss(
        self, tracker: Tracker, error: Exception, episode_id: int | None
    ) -> None:
        name = type(tracker).__name__
        logger.exception("%s has failed and is told nothing more.", name)
        self._trackers = tuple(each for each in self._trackers if each is not tracker)
        self._on_fault(name, error, episode_id)
        # So that it lets go of what it holds open, as far as it still can.
        with contextlib.suppress(Exception):
            tracker.end(self._run)

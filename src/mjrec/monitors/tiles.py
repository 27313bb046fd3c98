# SPDX-License-Identifier: Apache-2.0
"""Tiled videos of all sub-environments of a vector environment, side by side."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from ..environments.gymnasium_scenes import gymnasium_scenes
from ..errors import InvalidArgument, NoPictures
from ..formats.monitor_directory import video_prefix
from ..recorder.ending_reasons import CLOSE, RESET, ending
from ..recorder.live_videos import LiveVideos, live_recorder
from ..recorder.options import OFF, WARN, RecorderOptions
from ..schedules import disable_videos, to_schedule
from .base import EnvironmentMonitor
from .cameras import Tiles

logger = logging.getLogger(__name__)


def has_videos(options: RecorderOptions) -> bool:
    """Return whether any videos are recorded."""
    schedule = to_schedule(options.video_callable)
    return options.render != OFF and schedule is not disable_videos


def vector_tiles(
    envs: Sequence[Any], options: RecorderOptions, view: Mapping[str, Any]
) -> Tiles | None:
    """Return the frames of tiled videos of sub-environments; None without such videos.

    Args:
        envs: the sub-environments.
        options: the monitor's options.
        view: `camera`, `height` and `width`; only the first of several cameras is used.

    Raises:
        InvalidArgument: `keep` or `step_trigger` chooses the videos.
        NoPictures: a sub-environment provides no frames.
    """
    if not options.tiled:
        return None
    if options.keep is not None or options.step_trigger is not None:
        raise InvalidArgument(
            "tiled=True records all sub-environments during the first one's episodes "
            "that video_callable chooses, but with keep or step_trigger no episode is "
            "chosen when it starts. Use video_callable."
        )
    if not has_videos(options):
        return None
    camera = view["camera"]
    if isinstance(camera, list | tuple) and camera:
        view = {**view, "camera": camera[0]}
    tiles = Tiles([gymnasium_scenes(each, **view).frames for each in envs])
    if tiles.render_mode is None:
        raise NoPictures(
            "tiled=True was requested, and a tiled video needs the frames of all "
            "environments while they step: create them with "
            'render_mode="rgb_array", and with the required camera and size.'
        )
    return tiles


class TiledVideo:
    """A recorder of all sub-environments during the first one's scheduled episodes.

    Args:
        first: the monitor of the first sub-environment, whose manifest lists the
            videos.
        tiles: the frames of all sub-environments.
    """

    def __init__(self, first: EnvironmentMonitor, tiles: Tiles) -> None:
        self._first = first
        self._run = first.recorder.run
        self._tiles = tiles
        self._live: LiveVideos | None = None
        # The episode that the frames belong to.
        self._episode_id = -1
        self._ending: dict[str, Any] | None = None

    @property
    def is_recording(self) -> bool:
        """Whether a video is being recorded."""
        return self._live is not None

    def take_last(self) -> None:
        """Take the frame of the last step, if it was left out."""
        if self._live is not None and self._ending is None:
            self._live.take_last()

    def after_reset(self) -> None:
        """Start or end videos after a reset of the first sub-environment."""
        episode_id = self._first.episode_id - 1
        if self._live is not None and episode_id == self._episode_id:
            # After a reset before any step, the number is the same but the frame is
            # not.
            self._live.discard()
            self._live = None
        self._end_early(RESET)
        self._begin(episode_id)

    def after_step(self, *, terminated: bool, truncated: bool) -> None:
        """Record a step of all sub-environments.

        Args:
            terminated: whether the task ended the first sub-environment's episode.
            truncated: whether a limit outside the task ended it.
        """
        episode_id = self._first.episode_id - 1
        is_over = terminated or truncated
        self._ending = None
        if self._live is not None:
            stats = self._first.stats_recorder
            length, reward = stats.steps, stats.rewards
            if is_over:
                length, reward = stats.episode_lengths[-1], stats.episode_rewards[-1]
            self._live.say(length=length, reward=reward)
            if episode_id != self._episode_id:
                # With SAME_STEP, the first tile already shows the next episode.
                self._live.say(final_frame="missing")
            self._live.take(is_there=True, last=is_over)
        if is_over:
            self._end(complete=True, terminated=terminated, truncated=truncated)
        if episode_id != self._episode_id:
            self._begin(episode_id)

    def note_error(self, error: BaseException) -> None:
        """Note an exception, which marks the video if nothing is recorded after it."""
        if self._ending is None:
            self._ending = ending(error)

    def close(self) -> None:
        """Finish the running video. Idempotent."""
        self._end_early(CLOSE)

    def _begin(self, episode_id: int) -> None:
        self._episode_id = episode_id
        self._ending = None
        of_first, run = self._first.video_recorder, self._run
        if of_first is None or not of_first.enabled:
            return
        video = live_recorder(
            run,
            run.directory / f"{video_prefix(run.infix, episode_id)}.tiled",
            self._tiles,
            tiled=True,
            sub_environments=len(self._tiles.sources),
            length=0,
            reward=0.0,
        )
        self._live = LiveVideos(run, [video], tolerates=self._tolerates)
        self._live.begin()

    def _tolerates(self, error: Exception) -> bool:
        if self._run.options.on_error != WARN:
            return False
        logger.warning("A tiled video in %s failed: %s", self._first.directory, error)
        return True

    def _end_early(self, reason: str) -> None:
        self._end(complete=False, **(self._ending or {"reason": reason}))

    def _end(self, **facts: Any) -> None:
        live, self._live = self._live, None
        if live is not None:
            try:
                live.end(facts)
            finally:
                self._run.trackers.expect(live.path)

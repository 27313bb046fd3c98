# SPDX-License-Identifier: Apache-2.0
"""One video of all sub-environments of a vector environment, side by side."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping, Sequence
from typing import Any

from ..environments.gymnasium_frames import gymnasium_frames
from ..errors import InvalidArgument, NoPictures
from ..formats.monitor_directory import video_prefix
from ..recorder.ending_reasons import CLOSE, RESET, ending
from ..recorder.live_videos import LiveVideos
from ..recorder.options import OFF, WARN, RecorderOptions
from ..recorder.video_recorder import VideoRecorder, declared_rate
from ..schedules import disable_videos, to_schedule
from ..simulation.find_simulation import simulation_time
from .base import EnvironmentMonitor
from .cameras import Tiles

logger = logging.getLogger(__name__)


def has_videos(options: RecorderOptions) -> bool:
    """Return whether there are videos at all."""
    schedule = to_schedule(options.video_callable)
    return options.render != OFF and schedule is not disable_videos


def vector_tiles(
    envs: Sequence[Any], options: RecorderOptions, view: Mapping[str, Any]
) -> Tiles | None:
    """Return what tiled videos of sub-environments show; None where there are none.

    Args:
        envs: the sub-environments.
        options: what was asked for.
        view: `camera`, `height` and `width`; of several cameras the first is taken.

    Raises:
        InvalidArgument: nothing says which episodes the videos are to follow.
        NoPictures: not all sub-environments can be drawn.
    """
    if not options.tiled:
        return None
    if options.keep is not None or options.step_trigger is not None:
        raise InvalidArgument(
            "tiled=True records all sub-environments during the episodes that "
            "video_callable chooses of the first, and with keep or step_trigger no "
            "episode is chosen when it begins. Use video_callable."
        )
    if not has_videos(options):
        return None
    camera = view["camera"]
    if isinstance(camera, list | tuple) and camera:
        view = {**view, "camera": camera[0]}
    tiles = Tiles([gymnasium_frames(each, **view) for each in envs])
    if tiles.render_mode is None:
        raise NoPictures(
            "tiled=True was asked for, and a tiled video is drawn while the "
            "environments step, which needs frames of each of them: make them with "
            'render_mode="rgb_array", and with the camera and the size that are wanted.'
        )
    return tiles


class TiledVideo:
    """Records all sub-environments while the schedule has an episode of the first.

    Args:
        first: the monitor of the first sub-environment, whose manifest lists the
            videos.
        tiles: of all.
        options: what was asked for.
        env: the first sub-environment, which tells the rate.
    """

    def __init__(
        self,
        first: EnvironmentMonitor,
        tiles: Tiles,
        options: RecorderOptions,
        env: Any,
    ) -> None:
        self._first = first
        self._tiles = tiles
        self._options = options
        self._env = env
        self._live: LiveVideos | None = None
        # The episode that the frames are of.
        self._episode_id = -1
        self._ending: dict[str, Any] | None = None

    @property
    def is_recording(self) -> bool:
        """Whether a video is running."""
        return self._live is not None

    def take_last(self) -> None:
        """Take the frame of the last step, if it was left out."""
        if self._live is not None and self._ending is None:
            self._live.take_last()

    def after_reset(self) -> None:
        """Follow the first sub-environment, which has just been reset."""
        episode_id = self._first.episode_id - 1
        if self._live is not None and episode_id == self._episode_id:
            # Reset before any step: the number stays, the frame is another.
            self._live.discard()
            self._live = None
        self._end_early(RESET)
        self._begin(episode_id)

    def after_step(self, *, terminated: bool, truncated: bool) -> None:
        """Record a step of all sub-environments.

        Args:
            terminated: the task has ended the episode of the first.
            truncated: a limit from outside has.
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
                # SAME_STEP: the first tile shows the next episode already.
                self._live.say(final_frame="missing")
            self._live.take(is_there=True, last=is_over)
        if is_over:
            self._end(complete=True, terminated=terminated, truncated=truncated)
        if episode_id != self._episode_id:
            self._begin(episode_id)

    def note_error(self, error: BaseException) -> None:
        """Note that something was raised; the video is marked with it if it ends so."""
        if self._ending is None:
            self._ending = ending(error)

    def close(self) -> None:
        """Finish the running video. Idempotent."""
        self._end_early(CLOSE)

    def _begin(self, episode_id: int) -> None:
        self._episode_id = episode_id
        self._ending = None
        of_first, run = self._first.video_recorder, self._first.recorder.run
        if of_first is None or not of_first.enabled:
            return
        video = VideoRecorder(
            self._tiles,
            base_path=run.directory / f"{video_prefix(run.infix, episode_id)}.tiled",
            metadata={
                **run.live_facts(),
                "tiled": True,
                "sub_environments": len(self._tiles.sources),
                "length": 0,
                "reward": 0.0,
            },
            fps=self._options.fps,
            max_fps=self._options.max_fps,
            frame_hashes=True,
            clock=functools.partial(simulation_time, self._env),
            declared=functools.partial(declared_rate, self._env),
            facts=self._tiles.facts,
            strict=self._options.strict,
        )
        self._live = LiveVideos([video], tolerates=self._tolerates)
        self._live.begin()

    def _tolerates(self, error: Exception) -> bool:
        if self._options.on_error != WARN:
            return False
        logger.warning("A tiled video of %s: %s", self._first.directory, error)
        return True

    def _end_early(self, reason: str) -> None:
        self._end(complete=False, **(self._ending or {"reason": reason}))

    def _end(self, **facts: Any) -> None:
        live, self._live = self._live, None
        if live is not None:
            try:
                live.end(facts)
            finally:
                self._first.recorder.run.trackers.expect(live.path)

# SPDX-License-Identifier: Apache-2.0
"""One video of all sub-environments of a vector environment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

from ..errors import InvalidArgument, NoPictures
from ..formats.monitor_directory import Infix, video_prefix
from ..recorder.endings import CLOSE, RESET, ending
from ..recorder.live_videos import LiveVideos
from ..recorder.options import OFF, WARN, RecorderOptions
from ..recorder.video_recorder import VideoRecorder
from ..schedules import disable_videos, to_schedule
from .controls import MonitorControls
from .vector_pictures import TilePictures

logger = logging.getLogger(__name__)


def wants_tiles(options: RecorderOptions) -> bool:
    """Tell whether tiled videos were asked for, and there are videos at all.

    Raises:
        InvalidArgument: nothing says which episodes they are to follow.
    """
    if not options.tiled:
        return False
    if options.keep is not None or options.step_trigger is not None:
        raise InvalidArgument(
            "tiled=True records all sub-environments during the episodes that "
            "video_callable chooses of the first, and with keep or step_trigger no "
            "episode is chosen when it begins. Use video_callable."
        )
    has_videos = to_schedule(options.video_callable) is not disable_videos
    return has_videos and options.render != OFF


def check_tiled(pictures: TilePictures) -> None:
    """Check that all sub-environments can be drawn.

    Raises:
        NoPictures: they cannot.
    """
    if pictures.render_mode is None:
        raise NoPictures(
            "tiled=True was asked for, and a tiled video is drawn while the "
            "environments step, which needs pictures of each of them: make them with "
            'render_mode="rgb_array", and with the camera and the size that are wanted.'
        )


class TiledVideo:
    """Records all sub-environments while the schedule has an episode of the first.

    Args:
        first: the monitor of the first sub-environment, whose manifest lists the
            videos.
        pictures: of all.
        options: what was asked for.
        clock: returns the simulated time of the first, or None.
        declared: returns the rate to take where there is no simulated time.
    """

    def __init__(
        self,
        first: MonitorControls,
        pictures: TilePictures,
        options: RecorderOptions,
        *,
        clock: Callable[[], float | None],
        declared: Callable[[], Fraction],
    ) -> None:
        self._first = first
        self._pictures = pictures
        self._options = options
        self._clock = clock
        self._declared = declared
        self._video: VideoRecorder | None = None
        self._has_warned = False
        # The episode that the pictures are of, and how far it has come.
        self._episode_id = -1
        self._progress: dict[str, Any] = {}
        self._ending: dict[str, Any] | None = None

    @property
    def is_recording(self) -> bool:
        """Whether a video is running."""
        return self._video is not None

    def take_last(self) -> None:
        """Take the picture of the last step, if it was left out."""
        if self._video is not None and self._ending is None:
            self._videos(self._video).take_last()

    def after_reset(self) -> None:
        """Follow the first sub-environment, which has just been reset."""
        episode_id = self._first.episode_id - 1
        if self._video is not None and episode_id == self._episode_id:
            # Reset before any step: the number stays, the picture is another.
            self._video.discard()
            self._video = None
        self._end(self._incomplete(RESET))
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
        if self._video is not None:
            self._step(self._video, is_over, is_reset=episode_id != self._episode_id)
        if is_over:
            flags = {"terminated": terminated, "truncated": truncated}
            self._end({"complete": True, **flags})
        if episode_id != self._episode_id:
            self._begin(episode_id)

    def note_error(self, error: BaseException) -> None:
        """Note that something was raised; the video is marked with it if it ends so."""
        if self._ending is None:
            self._ending = ending(error)

    def close(self) -> None:
        """Finish the running video. Idempotent."""
        self._end(self._incomplete(CLOSE))

    def _begin(self, episode_id: int) -> None:
        self._episode_id = episode_id
        self._progress = {"length": 0, "reward": 0.0}
        self._ending = None
        video = self._first.video_recorder
        if video is None or not video.enabled:
            return
        infix = Infix.parse(self._first.infix)
        assert infix is not None
        base = self._first.directory / f"{video_prefix(infix, episode_id)}.tiled"
        self._video = VideoRecorder(
            self._pictures,
            base_path=base,
            metadata={
                **self._first._recorder.live_video_facts(),
                "tiled": True,
                "sub_environments": self._pictures.count,
            },
            fps=self._options.fps,
            max_fps=self._options.max_fps,
            frame_hashes=True,
            clock=self._clock,
            declared=self._declared,
            facts=self._pictures.facts,
            strict=self._options.strict,
        )
        self._videos(self._video).begin()

    def _step(self, video: VideoRecorder, is_over: bool, *, is_reset: bool) -> None:
        stats = self._first.stats_recorder
        if is_over:
            self._progress = {
                "length": stats.episode_lengths[-1],
                "reward": stats.episode_rewards[-1],
            }
        else:
            self._progress = {"length": stats.steps, "reward": stats.rewards}
        if is_reset:
            # The first tile shows the next episode already; the others are right.
            video.metadata["final_frame"] = "missing"
            self._warn_of_missing_frames()
        self._videos(video).take(is_there=True, last=is_over)

    def _warn_of_missing_frames(self) -> None:
        if self._has_warned:
            return
        self._has_warned = True
        logger.warning(
            "The last frame of each tiled video shows the first sub-environment after "
            "its reset, and others that have ended likewise: with SAME_STEP all of "
            "them are there to be drawn only when that is over. The sub-environments' "
            "own videos are whole where they are objects in this process."
        )

    def _videos(self, video: VideoRecorder) -> LiveVideos:
        return LiveVideos([video], tolerates=self._tolerates)

    def _tolerates(self, error: Exception) -> bool:
        if self._options.on_error != WARN or self._video is None:
            return False
        logger.warning("The tiled video %s: %s", self._video.path, error)
        return True

    def _incomplete(self, reason: str) -> dict[str, Any]:
        return {"complete": False, **(self._ending or {"reason": reason})}

    def _end(self, facts: Mapping[str, Any]) -> None:
        if self._video is not None:
            self._videos(self._video).end({**facts, **self._progress}, self._list)

    def _list(self, video: VideoRecorder) -> None:
        self._video = None
        self._first._recorder.add_video(video)

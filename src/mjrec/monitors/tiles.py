# SPDX-License-Identifier: Apache-2.0
"""Tiled videos, which show cameras or sub-environments side by side."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from ..environments.gymnasium_scenes import gymnasium_scenes
from ..errors import InvalidArgument, NoPictures
from ..formats.monitor_directory import further_parts, video_prefix
from ..frames import Frame, check_frame, grid_frame, grid_shape
from ..recorder.endings import CLOSE, RESET, ending
from ..recorder.live_videos import LiveVideos, live_recorder
from ..recorder.options import OFF, WARN, RecorderOptions
from ..recorder.recorded_environment import EpisodeFrames
from ..recorder.recorder import Recorder
from ..recorder.video_recorder import can_give_frames
from ..rendering.jobs import plain_camera
from ..schedules import disable_videos, to_schedule

logger = logging.getLogger(__name__)

_RGB_ARRAY = "rgb_array"


def checked_cameras(camera: Any, *, tiled: bool) -> list[Any]:
    """Return the requested cameras as a list.

    Args:
        camera: a name, a number, a `mujoco.MjvCamera`, None for the environment's own
            view, or a list of these.
        tiled: whether to put several cameras side by side in one video.

    Raises:
        InvalidArgument: the list is empty, contains a camera twice, or contains None
            after its first item; or `tiled` is True with a single camera.
    """
    cameras = list(camera) if _are_several(camera) else [camera]
    if not cameras:
        raise InvalidArgument(
            "camera=[] contains no camera. Pass one or more, or None for the "
            "environment's own view."
        )
    plain = _plain(cameras)
    if None in plain[1:]:
        raise InvalidArgument(
            "In a list of cameras, only the first may be None (the environment's own "
            f"view), got {cameras!r}."
        )
    twice = [each for place, each in enumerate(plain) if each in plain[:place]]
    if twice:
        raise InvalidArgument(f"The camera {twice[0]!r} appears twice in {cameras!r}.")
    if tiled and len(cameras) == 1:
        raise InvalidArgument(
            "tiled=True puts the frames of several cameras, or of a vector "
            "environment's sub-environments, side by side, but there is only one "
            f"of each (camera={camera!r}). Pass several cameras."
        )
    return cameras


def camera_frames(
    cameras: Sequence[Any], sources: Sequence[EpisodeFrames], *, tiled: bool
) -> dict[str, Any]:
    """Return the `RecordedEnvironment` arguments for the frames of cameras.

    These are `frames` and, with several cameras, `cameras` and `further_frames` (only
    if the frames exist and are not tiled).

    Args:
        cameras: the cameras.
        sources: the source of the frames of each camera.
        tiled: whether to put several cameras side by side in one video.
    """
    if len(cameras) == 1:
        return {"frames": sources[0]}
    plain = _plain(cameras)
    view: dict[str, Any] = {"frames": sources[0], "cameras": plain}
    without = [source for source in sources if not can_give_frames(source)]
    if without:
        # Either all are rendered by workers, or none are.
        view["frames"] = without[0]
    elif tiled:
        view["frames"] = Tiles(sources, are_cameras=True)
    else:
        further = zip(further_parts(plain), sources[1:], strict=True)
        view["further_frames"] = dict(further)
    return view


def recorded_view(camera: Any, size: Mapping[str, int | None]) -> dict[str, Any]:
    """Return the requested cameras and sizes for the journal, without default values.

    Args:
        camera: see `checked_cameras`.
        size: the requested `height` and `width`.
    """
    plain = _plain(camera if _are_several(camera) else [camera])
    view = {"camera": list(plain) if _are_several(camera) else plain[0]}
    view |= {name: side and int(side) for name, side in size.items()}
    return {name: value for name, value in view.items() if value is not None}


def _are_several(camera: Any) -> bool:
    return isinstance(camera, Sequence) and not isinstance(camera, str)


def _plain(cameras: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(None if each is None else plain_camera(each) for each in cameras)


class Tiles:
    """The frames of several sources, side by side.

    Args:
        sources: the sources of the frames.
        are_cameras: whether the sources are several cameras in one environment.
    """

    def __init__(
        self, sources: Sequence[EpisodeFrames], *, are_cameras: bool = False
    ) -> None:
        self.sources, self._are_cameras = sources, are_cameras

    @property
    def render_mode(self) -> str | None:
        """`rgb_array` if all sources have that mode, otherwise None."""
        modes = {source.render_mode for source in self.sources}
        return _RGB_ARRAY if modes == {_RGB_ARRAY} else None

    def render(self) -> Frame:
        """Return the current frame.

        Raises:
            InvalidArgument: the frames differ in size, or a frame is invalid.
        """
        return grid_frame([check_frame(source.render()) for source in self.sources])

    def facts(self) -> dict[str, Any]:
        """Return the facts about the frames for a video's metadata."""
        rows, columns = grid_shape(len(self.sources))
        size = {"tiled": True, "rows": rows, "columns": columns}
        facts = {**self.sources[0].facts(), **size}
        if self._are_cameras:
            facts["camera"] = [source.facts().get("camera") for source in self.sources]
        return facts


def has_videos(options: RecorderOptions) -> bool:
    """Return whether any videos are recorded."""
    schedule = to_schedule(options.video_callable)
    return options.render != OFF and schedule is not disable_videos


def vector_tiles(
    envs: Sequence[Any], options: RecorderOptions, view: Mapping[str, Any]
) -> Tiles | None:
    """Return the frames for tiled videos of sub-environments; None without such videos.

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
    camera = view.get("camera")
    if isinstance(camera, list | tuple) and camera:
        view = {**view, "camera": camera[0]}
    tiles = Tiles([gymnasium_scenes(each, **view).frames for each in envs])
    if tiles.render_mode is None:
        raise NoPictures(
            "tiled=True was requested, but a tiled video needs the frames of all "
            "environments at every step. Create the environments with "
            'render_mode="rgb_array" and with the required camera and size.'
        )
    return tiles


class TiledVideo:
    """A recorder for all sub-environments during the first one's scheduled episodes.

    Args:
        first: the recorder of the first sub-environment, whose manifest lists the
            videos.
        tiles: the frames of all sub-environments.
    """

    def __init__(self, first: Recorder, tiles: Tiles) -> None:
        self._first = first
        self._run = first.run
        self._tiles = tiles
        self._live: LiveVideos | None = None
        # The episode that the frames belong to.
        self._episode_id = -1
        self._ending: dict[str, Any] | None = None

    def take_last(self) -> None:
        """Take the frame of the last step if it was skipped."""
        if self._live is not None and self._ending is None:
            self._live.take_last()

    def after_reset(self) -> bool:
        """Start or end videos after a reset of the first sub-environment.

        Returns:
            Whether a video is being recorded.
        """
        episode_id = self._first.episode_id - 1
        if self._live is not None and episode_id == self._episode_id:
            # After a reset before any step, the number is the same but the frame is
            # not.
            self._live.discard()
            self._live = None
        self._end_early(RESET)
        self._begin(episode_id)
        return self._live is not None

    def after_step(self, *, terminated: bool, truncated: bool) -> bool:
        """Record a step of all sub-environments.

        Args:
            terminated: whether the task ended the first sub-environment's episode.
            truncated: whether a limit outside the task ended that episode.

        Returns:
            Whether a video is being recorded.
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
        return self._live is not None

    def note_error(self, error: BaseException) -> None:
        """Record an exception, which marks the video if nothing is recorded later."""
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

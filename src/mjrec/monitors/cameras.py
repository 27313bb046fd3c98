# SPDX-License-Identifier: Apache-2.0
"""Frames for monitors with one or several cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import InvalidArgument
from ..formats.monitor_directory import further_parts
from ..frames import Frame, check_frame, grid_frame, grid_shape
from ..recorder.recorded_environment import EpisodeFrames
from ..recorder.video_recorder import can_give_frames
from ..rendering.jobs import plain_camera

_RGB_ARRAY = "rgb_array"


def checked_cameras(camera: Any, *, tiled: bool) -> list[Any]:
    """Return the requested cameras as a list.

    Args:
        camera: a name, a number, an `mujoco.MjvCamera`, None for the environment's own
            view, or a list of these.
        tiled: whether to put several cameras side by side in one video.

    Raises:
        InvalidArgument: the list is empty, contains a camera twice, or contains None
            after its first item; or `tiled` is True with a single camera.
    """
    cameras = list(camera) if _are_several(camera) else [camera]
    if not cameras:
        raise InvalidArgument(
            "camera=[] contains no camera: name one or more, or give None for the "
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
            f"of each: got the camera {camera!r}. Give several cameras."
        )
    return cameras


def camera_frames(
    cameras: Sequence[Any], sources: Sequence[EpisodeFrames], *, tiled: bool
) -> dict[str, Any]:
    """Return the arguments for `RecordedEnvironment` about the frames of cameras.

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
        # Either all are rendered by workers or none is.
        view["frames"] = without[0]
    elif tiled:
        view["frames"] = _CameraTiles(sources)
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
    """

    def __init__(self, sources: Sequence[EpisodeFrames]) -> None:
        self.sources = sources

    @property
    def render_mode(self) -> str | None:
        """`rgb_array` if all sources have it, otherwise None."""
        modes = {source.render_mode for source in self.sources}
        return _RGB_ARRAY if modes == {_RGB_ARRAY} else None

    def render(self) -> Frame:
        """Return the current frame.

        Raises:
            InvalidArgument: the frames differ in size, or one is not a valid frame.
        """
        return grid_frame([check_frame(source.render()) for source in self.sources])

    def facts(self) -> dict[str, Any]:
        """Return the facts about the frames for a video's metadata."""
        rows, columns = grid_shape(len(self.sources))
        facts = self.sources[0].facts()
        return {**facts, "tiled": True, "rows": rows, "columns": columns}


class _CameraTiles(Tiles):
    """The frames of several cameras side by side."""

    def facts(self) -> dict[str, Any]:
        cameras = [source.facts().get("camera") for source in self.sources]
        return {**super().facts(), "camera": cameras}

# SPDX-License-Identifier: Apache-2.0
"""The frames of a monitor with one camera or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..errors import InvalidArgument
from ..formats.monitor_directory import further_parts
from ..frames import Frame, check_frame, grid_frame, grid_shape
from ..recorder.recorded_environment import EpisodeFrames
from ..recorder.video_recorder import can_give_frames
from ..rendering.views import plain_camera

_RGB_ARRAY = "rgb_array"


def camera_frames(
    camera: Any, frames_from: Callable[[Any], EpisodeFrames], *, tiled: bool
) -> tuple[Any, dict[str, Any]]:
    """Return the frames from a camera, or from each of several.

    Args:
        camera: a name, a number, an `mujoco.MjvCamera`, None for what the environment
            itself shows, or a list of these.
        frames_from: makes the frames from one camera.
        tiled: those of several cameras side by side, in one video.

    Returns:
        The only camera, or the first, the one that scenes are recorded with; and what
        `RecordedEnvironment` gets: `frames`, `further_frames` and `cameras`.

    Raises:
        InvalidArgument: the list is empty, or has one camera twice, or None in another
            place than the first; or there is nothing to lay side by side.
        UnknownName: the model has no such camera.
    """
    several = isinstance(camera, Sequence) and not isinstance(camera, str)
    cameras = list(camera) if several else [camera]
    if several:
        _check(cameras)
    if len(cameras) == 1:
        if tiled:
            raise InvalidArgument(
                "tiled=True lays the frames of several cameras, or those of the "
                "sub-environments of a vector environment, side by side, and here is "
                f"one of each: got the camera {camera!r}. Give several."
            )
        return cameras[0], {"frames": frames_from(cameras[0])}
    plain = tuple(None if each is None else plain_camera(each) for each in cameras)
    sources = [frames_from(each) for each in cameras]
    view: dict[str, Any] = {"frames": sources[0], "cameras": plain}
    without = [source for source in sources if not can_give_frames(source)]
    if without:
        # All are drawn by workers, or none is.
        view["frames"] = without[0]
    elif tiled:
        view["frames"] = _CameraTiles(sources)
    else:
        further = zip(further_parts(plain), sources[1:], strict=True)
        view["further_frames"] = dict(further)
    return cameras[0], view


def recorded_view(
    camera: Any, *, height: int | None, width: int | None, own: Any = None
) -> dict[str, Any]:
    """Return what a journal says of how a run is shown; what is the default is not.

    Args:
        camera: as of `camera_frames`.
        height: that was asked for.
        width: likewise.
        own: number or name of the camera that the environment shows by itself.
    """
    several = isinstance(camera, Sequence) and not isinstance(camera, str)
    plain = [
        None if each is None else plain_camera(each)
        for each in (camera if several else [camera])
    ]
    view = {
        "camera": plain if several else plain[0],
        "height": None if height is None else int(height),
        "width": None if width is None else int(width),
        "own_camera": own,
    }
    return {name: value for name, value in view.items() if value is not None}


def _check(cameras: list[Any]) -> None:
    if not cameras:
        raise InvalidArgument(
            "camera=[] is no camera: name one or more, or give None for what the "
            "environment itself shows."
        )
    plain = [None if each is None else plain_camera(each) for each in cameras]
    if None in plain[1:]:
        raise InvalidArgument(
            "In a list of cameras only the first may be None, what the environment "
            f"itself shows, got {cameras!r}."
        )
    twice = [each for place, each in enumerate(plain) if each in plain[:place]]
    if twice:
        raise InvalidArgument(f"The camera {twice[0]!r} is there twice in {cameras!r}.")


class Tiles:
    """The frames of several sources, side by side.

    Args:
        sources: of the frames.
    """

    def __init__(self, sources: Sequence[EpisodeFrames]) -> None:
        self.sources = sources

    @property
    def render_mode(self) -> str | None:
        """`rgb_array` where all sources have it; None else."""
        modes = {source.render_mode for source in self.sources}
        return _RGB_ARRAY if modes == {_RGB_ARRAY} else None

    def render(self) -> Frame:
        """Return the frame of this moment.

        Raises:
            InvalidArgument: the frames are not of one size, or one is none.
        """
        return grid_frame([check_frame(source.render()) for source in self.sources])

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its frames."""
        rows, columns = grid_shape(len(self.sources))
        facts = self.sources[0].facts()
        return {**facts, "tiled": True, "rows": rows, "columns": columns}


class _CameraTiles(Tiles):
    """The frames of several cameras side by side."""

    def facts(self) -> dict[str, Any]:
        cameras = [source.facts().get("camera") for source in self.sources]
        return {**super().facts(), "camera": cameras}

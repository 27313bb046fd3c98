# SPDX-License-Identifier: Apache-2.0
"""Settings for rendering that differ from those of the recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from ..errors import InvalidArgument, UnknownName
from ..frames import check_quality, check_size
from ..rates import to_rate

PlainCamera: TypeAlias = str | int | dict[str, Any]

# The public members of a `mujoco.MjvCamera`.
CAMERA_MEMBERS = (
    *("type", "fixedcamid", "trackbodyid", "lookat", "distance"),
    *("azimuth", "elevation", "orthographic"),
)


@dataclass(frozen=True, kw_only=True)
class View:
    """The camera, size and quality of frames; None means as recorded.

    Attributes:
        camera: the name or number of one of the model's cameras, -1 for the free
            camera where the model places it, or the members of a `mujoco.MjvCamera` by
            name (MuJoCo's defaults for those left out). Any value that `plain_camera`
            accepts may be passed.
        height: height in pixels.
        width: width in pixels.
        quality: `"full"` or `"draft"`.

    Raises:
        UnknownName: the quality, or a member of the `MjvCamera`, does not exist.
        InvalidArgument: the size or the camera is invalid. Whether the model has the
            camera is not checked here.
    """

    camera: PlainCamera | None = None
    height: int | None = None
    width: int | None = None
    quality: str | None = None

    def __post_init__(self) -> None:
        check_size(
            1 if self.height is None else self.height,
            1 if self.width is None else self.width,
        )
        if self.quality is not None:
            check_quality(self.quality)
        # Convert NumPy integers and an `MjvCamera` to plain values.
        plain: Mapping[str, Callable[[Any], object]]
        plain = {"camera": plain_camera, "height": int, "width": int}
        for name, make in plain.items():
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, make(value))


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Changes for re-rendering a recording; None means as recorded.

    Attributes:
        view: the camera, size and quality.
        max_fps: maximum frames per second of simulated time. Of the recorded frames,
            0, n, 2n ... with the smallest n that fits, and the last are drawn.
        fps: frames per second of the file. If None, the video plays at its recorded
            speed.
        annotate: whether episode, step, time and return are written on the frames.

    Raises:
        InvalidArgument: `max_fps` or `fps` is not a valid rate.
    """

    view: View = field(default_factory=View)
    max_fps: float | Fraction | None = None
    fps: float | Fraction | None = None
    annotate: bool | None = None

    def __post_init__(self) -> None:
        for rate in (self.max_fps, self.fps):
            if rate is not None:
                to_rate(rate)


def plain_camera(camera: Any) -> PlainCamera:
    """Return a camera in a JSON-serialisable form.

    Args:
        camera: a name, a number, a `mujoco.MjvCamera`, or a mapping of its members.

    Raises:
        UnknownName: a key of the mapping is not a member of `MjvCamera`.
        InvalidArgument: `camera` has a different type, or a member's value is invalid.
    """
    if isinstance(camera, str):
        return camera
    if isinstance(camera, int | np.integer) and not isinstance(camera, bool):
        return int(camera)
    if isinstance(camera, Mapping):
        return {name: _plain_member(name, camera[name]) for name in camera}
    # Compared by type name, so that mujoco need not be imported here.
    if type(camera).__name__ == "MjvCamera":
        return {n: _plain_member(n, getattr(camera, n)) for n in CAMERA_MEMBERS}
    raise InvalidArgument(
        "A camera must be a name, a number, a mujoco.MjvCamera or a mapping of its "
        f"members, got {camera!r} of type {type(camera).__name__}."
    )


def _plain_member(name: str, value: Any) -> Any:
    if name not in CAMERA_MEMBERS:
        raise UnknownName("member of mujoco.MjvCamera", name, CAMERA_MEMBERS)
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    expected = (3,) if name == "lookat" else ()
    if numbers.shape != expected or not np.isfinite(numbers).all():
        what = "three numbers" if expected else "a number"
        raise InvalidArgument(f"A camera's {name} must be {what}, got {value!r}.")
    if name in ("lookat", "distance", "azimuth", "elevation"):
        return numbers.tolist()
    return int(numbers)

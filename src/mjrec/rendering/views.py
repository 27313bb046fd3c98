# SPDX-License-Identifier: Apache-2.0
"""How frames of a recording are wanted, as far as other than recorded."""

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

# The public members of an `mujoco.MjvCamera`.
CAMERA_MEMBERS = (
    *("type", "fixedcamid", "trackbodyid", "lookat", "distance"),
    *("azimuth", "elevation", "orthographic"),
)


@dataclass(frozen=True, kw_only=True)
class View:
    """From where, how large and how well frames are drawn; None is as recorded.

    Attributes:
        camera: the name or number of one of the model's cameras, -1 for the free
            camera in the place that the model gives it, or the members of an
            `mujoco.MjvCamera` by their names (those left out are MuJoCo's default).
            It may be given as `plain_camera` takes it.
        height: in pixels.
        width: in pixels.
        quality: `"full"` or `"draft"`.

    Raises:
        UnknownName: there is no such quality, or an `MjvCamera` has no such member.
        InvalidArgument: a size or a camera that cannot be. Whether the model has the
            camera is not known here.
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
        # A NumPy integer is as good as any, and so is an `MjvCamera`.
        plain: Mapping[str, Callable[[Any], object]]
        plain = {"camera": plain_camera, "height": int, "width": int}
        for name, make in plain.items():
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, make(value))


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What is to be other than recorded; None is as recorded.

    Attributes:
        view: from where, how large and how well it is drawn.
        max_fps: the most frames per second of simulated time: frames 0, n, 2n ... of
            those recorded, with the smallest n that fits, and the last.
        fps: frames per second of the file. If None, a second of the video is as much
            simulated time as when the episode was recorded.
        annotate: whether episode, step, time and return are written on the frames.

    Raises:
        InvalidArgument: one is no rate.
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
    """Return a camera in what JSON can hold.

    Args:
        camera: a name, a number, an `mujoco.MjvCamera`, or a mapping of its members.

    Raises:
        UnknownName: the mapping has a key that is no member.
        InvalidArgument: it is none of these.
    """
    if isinstance(camera, str):
        return camera
    if isinstance(camera, int | np.integer) and not isinstance(camera, bool):
        return int(camera)
    if isinstance(camera, Mapping):
        return {name: _plain_member(name, camera[name]) for name in camera}
    # By its name: a caller who has one has imported mujoco, and others need not.
    if type(camera).__name__ == "MjvCamera":
        return {n: _plain_member(n, getattr(camera, n)) for n in CAMERA_MEMBERS}
    raise InvalidArgument(
        "A camera is a name, a number, a mujoco.MjvCamera or a mapping of its members, "
        f"got {camera!r} of type {type(camera).__name__}."
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
        raise InvalidArgument(f"A camera's {name} is {what}, got {value!r}.")
    if name in ("lookat", "distance", "azimuth", "elevation"):
        return numbers.tolist()
    return int(numbers)

# SPDX-License-Identifier: Apache-2.0
"""Cameras and options as the frameworks' viewers settle them, without a viewer.

A viewer makes an OpenGL context, and a recording of states must do without one.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

__all__ = [
    "new_scene_flags",
    "place_free_camera",
    "shown_camera",
    "viewer_camera",
    "viewer_option",
]

_FREE = int(mujoco.mjtCamera.mjCAMERA_FREE)
_FIXED = int(mujoco.mjtCamera.mjCAMERA_FIXED)


def place_free_camera(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
    """Put a camera where the model's fields, as they are now, have the free camera."""
    mujoco.mjv_defaultFreeCamera(model, camera)


def viewer_camera(
    model: mujoco.MjModel, data: mujoco.MjData, config: Mapping[str, Any] | None
) -> mujoco.MjvCamera:
    """Return the camera of a viewer that Gymnasium makes at this moment.

    It looks at the median of where the geoms are now, and stays: a viewer made later
    shows another picture of the same state.

    Args:
        model: the model.
        data: its data.
        config: members of the camera by their names, as environments give them
            (`default_camera_config`).
    """
    camera = mujoco.MjvCamera()
    camera.type = _FREE
    camera.fixedcamid = -1
    camera.lookat[:] = np.median(data.geom_xpos, axis=0) if model.ngeom else 0
    camera.distance = model.stat.extent
    for name, value in (config or {}).items():
        if isinstance(value, np.ndarray):
            getattr(camera, name)[:] = value
        else:
            setattr(camera, name, value)
    return camera


def shown_camera(camera: mujoco.MjvCamera, camera_id: int | None) -> mujoco.MjvCamera:
    """Return what Gymnasium's viewer with `camera` shows if asked for a number.

    Args:
        camera: is given back itself if it is what is shown, and never changed.
        camera_id: of one of the model's cameras; -1 is a free camera, placed as
            `camera` is; None is `camera`, whatever it is.
    """
    if camera_id is None:
        return camera
    kind = _FREE if camera_id == -1 else _FIXED
    if camera.type == kind and camera.fixedcamid == camera_id:
        return camera
    shown = copy.copy(camera)
    shown.type = kind
    shown.fixedcamid = camera_id
    return shown


def viewer_option(flags: Mapping[int, bool] | None = None) -> mujoco.MjvOption:
    """Return MuJoCo's default option with some of its flags set."""
    option = mujoco.MjvOption()
    for flag, value in (flags or {}).items():
        option.flags[flag] = value
    return option


def new_scene_flags(model: mujoco.MjModel) -> bytes:
    """Return the rendering flags of a new scene."""
    return bytes(mujoco.MjvScene(model, maxgeom=1).flags.tobytes())

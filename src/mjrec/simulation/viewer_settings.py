# SPDX-License-Identifier: Apache-2.0
"""Cameras and options as the frameworks' viewers settle them, without a viewer.

A viewer makes an OpenGL context, and a recording of states must do without one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

_FREE = int(mujoco.mjtCamera.mjCAMERA_FREE)
_FIXED = int(mujoco.mjtCamera.mjCAMERA_FIXED)


def option_without_rangefinder() -> mujoco.MjvOption:
    """Return dm_control's default option, which differs from MuJoCo's in one flag."""
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
    return option


def place_free_camera(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
    """Put a camera where the model's fields, as they are now, have the free camera."""
    mujoco.mjv_defaultFreeCamera(model, camera)


def place_viewer_camera(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    config: Mapping[str, Any] | None,
    camera: mujoco.MjvCamera,
) -> None:
    """Put a camera where a viewer that Gymnasium makes at this moment has its own.

    It looks at the median of where the geoms are now, and stays: a viewer made later
    shows another picture of the same state.

    Args:
        model: the model.
        data: its data.
        config: members of the camera by their names, as environments give them
            (`default_camera_config`).
        camera: is put there.
    """
    mujoco.mjv_defaultCamera(camera)
    camera.type = _FREE
    camera.fixedcamid = -1
    camera.lookat[:] = np.median(data.geom_xpos, axis=0)
    camera.distance = model.stat.extent
    for name, value in (config or {}).items():
        if isinstance(value, np.ndarray):
            getattr(camera, name)[:] = value
        else:
            setattr(camera, name, value)


def select_camera(camera: mujoco.MjvCamera, camera_id: int | None) -> None:
    """Do to a viewer's camera what Gymnasium does when it draws.

    Args:
        camera: of the viewer.
        camera_id: of one of the model's cameras; -1 is a free camera, wherever it is;
            None leaves it as it is.
    """
    if camera_id is not None:
        camera.type = _FREE if camera_id == -1 else _FIXED
        camera.fixedcamid = camera_id


def copy_members(source: object, target: object) -> None:
    """Make a camera, or an option, say what another says.

    Args:
        source: an `MjvCamera` or `MjvOption`.
        target: another of the same.
    """
    for name in _MEMBERS[type(target)]:
        value = getattr(source, name)
        if isinstance(value, np.ndarray):
            getattr(target, name)[...] = value
        else:
            setattr(target, name, value)


def viewer_option(flags: Mapping[int, bool] | None = None) -> mujoco.MjvOption:
    """Return MuJoCo's default option with some of its flags set."""
    option = mujoco.MjvOption()
    for flag, value in (flags or {}).items():
        option.flags[flag] = value
    return option


def new_scene_flags(model: mujoco.MjModel) -> bytes:
    """Return the rendering flags of a new scene."""
    return bytes(mujoco.MjvScene(model, maxgeom=1).flags.tobytes())


def _members(kind: type) -> list[str]:
    names = (name for name in dir(kind) if not name.startswith("_"))
    return [name for name in names if not callable(getattr(kind, name))]


_MEMBERS = {kind: _members(kind) for kind in (mujoco.MjvCamera, mujoco.MjvOption)}

# SPDX-License-Identifier: Apache-2.0
"""Cameras: finding them by name or number, and choosing a model's default camera.

Every function accepts MuJoCo's own objects or wrappers around them. A wrapper holds the
original object in `.ptr`, as in dm_control.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import mujoco
import numpy as np

from ..errors import InvalidArgument, UnknownName

Camera: TypeAlias = "str | int | mujoco.MjvCamera"

FREE_CAMERA = -1

# Plain integers, because since mujoco 3.12 a member of a MuJoCo enum is not equal to
# the NumPy integer with the same value.
_FREE = int(mujoco.mjtCamera.mjCAMERA_FREE)
_FIXED = int(mujoco.mjtCamera.mjCAMERA_FIXED)
_TRACKING = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
_TRACK = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
# The members that the metadata includes for a camera that is not fixed.
_POSE = (
    *("type", "trackbodyid", "lookat", "distance", "azimuth", "elevation"),
    "orthographic",
)
_TRAVELLING_JOINTS = (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def raw_model(model: Any) -> mujoco.MjModel:
    """Return `model`, or the `mujoco.MjModel` that it wraps.

    Raises:
        InvalidArgument: `model` is neither a model nor a wrapper around one.
    """
    return _unwrapped(model, mujoco.MjModel)


def raw_data(data: Any) -> mujoco.MjData:
    """Return `data`, or the `mujoco.MjData` that it wraps.

    Raises:
        InvalidArgument: `data` is neither an `MjData` nor a wrapper around one.
    """
    return _unwrapped(data, mujoco.MjData)


def camera_names(model: Any) -> list[str]:
    """Return the names of the model's cameras in order, without unnamed cameras."""
    model = raw_model(model)
    names = (model.camera(index).name for index in range(model.ncam))
    return [name for name in names if name]


def resolve_camera(model: Any, camera: Camera | Mapping[str, Any]) -> mujoco.MjvCamera:
    """Return a camera that is ready for `mjv_updateScene`.

    Args:
        model: the model that the camera belongs to.
        camera: the name or number of one of the model's cameras; -1 for the free
            camera at the model's default pose; a mapping from names of public
            `MjvCamera` members to values (other members keep MuJoCo's defaults); or an
            `MjvCamera`, which is returned unchanged.

    Raises:
        UnknownName: the model has no camera with that name, or `MjvCamera` has no such
            member.
        InvalidArgument: the model has no camera with that number, `camera` has the
            wrong type, or its members refer to something that is not in the model.
    """
    model = raw_model(model)
    if isinstance(camera, mujoco.MjvCamera):
        return camera
    resolved = mujoco.MjvCamera()
    if isinstance(camera, Mapping):
        for name, value in camera.items():
            if name.startswith("_") or not hasattr(resolved, name):
                known = [known for known in dir(resolved) if not known.startswith("_")]
                raise UnknownName("mujoco.MjvCamera member", name, known)
            setattr(resolved, name, value)
        check_camera(model, resolved)
        return resolved
    index = _camera_index(model, camera)
    if index == FREE_CAMERA:
        mujoco.mjv_defaultFreeCamera(model, resolved)
    else:
        resolved.type = mujoco.mjtCamera.mjCAMERA_FIXED
        resolved.fixedcamid = index
    return resolved


def check_camera(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
    """Check that the model has the body or the fixed camera to which a camera refers.

    Raises:
        InvalidArgument: the model lacks this body or camera, or the type is invalid.
    """
    numbered = {
        _FIXED: ("fixedcamid", model.ncam),
        _TRACKING: ("trackbodyid", model.nbody),
    }
    kind = int(camera.type)
    if kind == _FREE:
        return
    if kind not in numbered:
        raise InvalidArgument(
            f"A camera's type must be free (0), tracking (1) or fixed (2), not {kind}."
        )
    what, count = numbered[kind]
    if not 0 <= (number := getattr(camera, what)) < count:
        raise InvalidArgument(
            f"A camera's {what} must be from 0 to {count - 1} in this model, but it is "
            f"{number}."
        )


def is_tracking(camera: object) -> bool:
    """Return whether a camera moves part of the way toward a body in each frame."""
    return isinstance(camera, mujoco.MjvCamera) and int(camera.type) == _TRACKING


def tracking_camera(model: Any) -> str | int | None:
    """Return the camera in the model that follows the robot, if there is one.

    This is the first camera that follows the center of mass of a body's subtree
    (`mode="trackcom"`). If there is none, it is the first camera that follows a body
    (`mode="track"`) of a robot that can travel, that is, has a free or sliding joint to
    the world. An arm with a fixed base cannot travel, and a camera that follows its
    hand is a close-up.

    Returns:
        The camera's name, or its number if it has no name. None if no camera follows
        the robot.
    """
    model = raw_model(model)
    candidates = np.flatnonzero(model.cam_mode == _TRACKCOM).tolist()
    for index in np.flatnonzero(model.cam_mode == _TRACK).tolist():
        if _travels(model, model.cam_bodyid[index]):
            candidates.append(index)
    return _name_of(model, candidates[0]) if candidates else None


def default_camera(model: Any) -> str | int:
    """Return the camera to use by default.

    This is the camera that follows the robot, because robots leave the frame of any
    other camera. If no camera follows the robot, it is the model's first camera, which
    suits the scene better than MuJoCo's free camera. If the model has no cameras, it is
    the free camera.

    Returns:
        The camera's name, or its number if it has no name. -1 means the free camera.
    """
    tracking = tracking_camera(model)
    if tracking is not None:
        return tracking
    model = raw_model(model)
    return _name_of(model, 0) if model.ncam else FREE_CAMERA


def camera_label(model: mujoco.MjModel, camera: Any) -> str | int | dict[str, Any]:
    """Return a camera's metadata label: its name, its number or a free camera's pose.

    Args:
        model: the model that has the camera.
        camera: see `resolve_camera`.
    """
    if isinstance(camera, str):
        return camera
    if isinstance(camera, Mapping):
        camera = resolve_camera(model, camera)
    if isinstance(camera, mujoco.MjvCamera):
        if int(camera.type) != _FIXED:
            return {name: np.array(getattr(camera, name)).tolist() for name in _POSE}
        camera = camera.fixedcamid
    return _name_of(model, int(camera))


def _name_of(model: mujoco.MjModel, number: int) -> str | int:
    """Return a camera's name, or its number if it has no name."""
    return number if number < 0 else model.camera(number).name or number


def has_infinite_plane(model: mujoco.MjModel) -> bool:
    """Return whether the model has an infinite plane, which follows the cameras."""
    planes = model.geom_size[model.geom_type == _PLANE]
    return bool((planes[:, :2] <= 0).any())


def _travels(model: mujoco.MjModel, body: int) -> bool:
    root = model.body_rootid[body]
    joints = model.jnt_type[model.jnt_bodyid == root]
    return bool(np.isin(joints, _TRAVELLING_JOINTS).any())


def _unwrapped(holder: object, kind: type) -> Any:
    for candidate in (holder, getattr(holder, "ptr", None)):
        if isinstance(candidate, kind):
            return candidate
    raise InvalidArgument(
        f"This must be a mujoco.{kind.__name__} or a dm_control wrapper for one, not "
        f"{type(holder).__module__}.{type(holder).__qualname__}."
    )


def _camera_index(model: mujoco.MjModel, camera: object) -> int:
    if isinstance(camera, str):
        kind = int(mujoco.mjtObj.mjOBJ_CAMERA)
        # An empty name would match the first unnamed camera.
        index = mujoco.mj_name2id(model, kind, camera) if camera else -1
        if index < 0:
            hint = "Or use -1 for the free camera."
            raise UnknownName("camera", camera, camera_names(model), hint=hint)
        return int(index)
    if isinstance(camera, bool) or not isinstance(camera, int | np.integer):
        raise InvalidArgument(
            "A camera must be a name, a number or a mujoco.MjvCamera, not "
            f"{camera!r} of type {type(camera).__name__}."
        )
    if not FREE_CAMERA <= camera < model.ncam:
        raise InvalidArgument(
            f"Camera number {camera} does not exist: this model has {model.ncam} "
            f"cameras. Use a number from -1 (the free camera) to {model.ncam - 1}."
        )
    return int(camera)

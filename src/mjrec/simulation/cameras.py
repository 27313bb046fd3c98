# SPDX-License-Identifier: Apache-2.0
"""Which camera is meant: a name, a number or an `MjvCamera`, and what a model has.

Every function takes MuJoCo's own objects or a wrapper that holds one as `.ptr`, as
dm_control's do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import mujoco
import numpy as np

from ..errors import InvalidArgument, UnknownName

Camera: TypeAlias = "str | int | mujoco.MjvCamera"

FREE_CAMERA = -1

# Plain integers, because since mujoco 3.12 a member of a MuJoCo enumeration is not
# equal to the NumPy integer of its value.
_TRACK = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
_TRAVELLING_JOINTS = (
    int(mujoco.mjtJoint.mjJNT_FREE),
    int(mujoco.mjtJoint.mjJNT_SLIDE),
)


def raw_model(model: Any) -> mujoco.MjModel:
    """Return the `mujoco.MjModel` that `model` is or holds as `.ptr`.

    Raises:
        InvalidArgument: there is none.
    """
    return _unwrapped(model, mujoco.MjModel)


def raw_data(data: Any) -> mujoco.MjData:
    """Return the `mujoco.MjData` that `data` is or holds as `.ptr`.

    Raises:
        InvalidArgument: there is none.
    """
    return _unwrapped(data, mujoco.MjData)


def camera_names(model: Any) -> list[str]:
    """Return the names of the model's cameras in its order, without the nameless."""
    model = raw_model(model)
    names = (model.camera(index).name for index in range(model.ncam))
    return [name for name in names if name]


def resolve_camera(model: Any, camera: Camera | Mapping[str, Any]) -> mujoco.MjvCamera:
    """Return the camera that is meant, ready for `mjv_updateScene`.

    Args:
        model: the model that the camera belongs to.
        camera: the name or number of one of the model's cameras, -1 for the free
            camera in the place that the model gives it, the public members of an
            `MjvCamera` by their names (those left out are MuJoCo's default), or an
            `MjvCamera`, which is given back as it is.

    Raises:
        UnknownName: the model has no camera of that name, or there is no such member.
        InvalidArgument: it has no camera of that number, or `camera` is none of these,
            or its members follow something that the model lacks.
    """
    model = raw_model(model)
    if isinstance(camera, mujoco.MjvCamera):
        return camera
    resolved = mujoco.MjvCamera()
    if isinstance(camera, Mapping):
        for name, value in camera.items():
            if name.startswith("_") or not hasattr(resolved, name):
                known = [known for known in dir(resolved) if not known.startswith("_")]
                raise UnknownName("member of mujoco.MjvCamera", name, known)
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
    """Check that what a camera follows, or is fixed to, is in the model.

    Raises:
        InvalidArgument: it is not, or there is no such kind of camera.
    """
    fixed, tracking = (
        mujoco.mjtCamera.mjCAMERA_FIXED,
        mujoco.mjtCamera.mjCAMERA_TRACKING,
    )
    numbered = {
        int(fixed): ("fixedcamid", model.ncam),
        int(tracking): ("trackbodyid", model.nbody),
    }
    kind = int(camera.type)
    if kind == int(mujoco.mjtCamera.mjCAMERA_FREE):
        return
    if kind not in numbered:
        raise InvalidArgument(
            f"A camera's type is free (0), tracking (1) or fixed (2), got {kind}."
        )
    what, count = numbered[kind]
    if not 0 <= (number := getattr(camera, what)) < count:
        raise InvalidArgument(
            f"A camera's {what} is {number}, and this model has {count} of these: 0 to "
            f"{count - 1}."
        )


def is_tracking(camera: object) -> bool:
    """Return whether each frame moves a camera, a part of the way to a body."""
    tracking = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
    return isinstance(camera, mujoco.MjvCamera) and int(camera.type) == tracking


def tracking_camera(model: Any) -> str | int | None:
    """Return the camera of the model that follows its robot, if it has one.

    The first that follows the centre of mass of a body's subtree (`mode="trackcom"`);
    else the first that follows a body (`mode="track"`) of something that can travel,
    which is what hangs on a free or a sliding joint in the world. An arm with a fixed
    base cannot, and a camera that follows its hand is a close-up.

    Returns:
        Its name, or its number if it has none; None if no camera follows the robot.
    """
    model = raw_model(model)
    modes = model.cam_mode.tolist()
    bodies = model.cam_bodyid.tolist()
    candidates = [index for index, mode in enumerate(modes) if mode == _TRACKCOM]
    candidates += [
        index
        for index, mode in enumerate(modes)
        if mode == _TRACK and _travels(model, bodies[index])
    ]
    return _name_of(model, candidates[0]) if candidates else None


def default_camera(model: Any) -> str | int:
    """Return the camera that follows the robot, else the first, else the free one.

    Robots leave the frame of a camera that does not follow them. Where none follows,
    the author's first camera knows more of the scene than MuJoCo's free one.

    Returns:
        A name, or a number for a camera that has no name; -1 is the free camera.
    """
    tracking = tracking_camera(model)
    if tracking is not None:
        return tracking
    model = raw_model(model)
    return _name_of(model, 0) if model.ncam else FREE_CAMERA


def camera_label(model: mujoco.MjModel, camera: Any) -> str | int | dict[str, Any]:
    """Return a camera as metadata says it: a name, a number, or a free camera's pose.

    Args:
        model: has the camera.
        camera: as `resolve_camera` takes it.
    """
    if isinstance(camera, str):
        return camera
    if isinstance(camera, Mapping):
        camera = resolve_camera(model, camera)
    if isinstance(camera, mujoco.MjvCamera):
        if int(camera.type) != int(mujoco.mjtCamera.mjCAMERA_FIXED):
            return {
                "type": int(camera.type),
                "trackbodyid": int(camera.trackbodyid),
                "lookat": camera.lookat.tolist(),
                "distance": float(camera.distance),
                "azimuth": float(camera.azimuth),
                "elevation": float(camera.elevation),
                "orthographic": int(camera.orthographic),
            }
        camera = camera.fixedcamid
    return _name_of(model, int(camera))


def _name_of(model: mujoco.MjModel, number: int) -> str | int:
    """Return a camera's name, or its number where it has none."""
    return number if number < 0 else model.camera(number).name or number


def has_infinite_plane(model: mujoco.MjModel) -> bool:
    """Return whether a plane has no end: it is drawn around the cameras."""
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
        f"A mujoco.{kind.__name__}, or dm_control's wrapper of one, is needed, got "
        f"{type(holder).__module__}.{type(holder).__qualname__}."
    )


def _camera_index(model: mujoco.MjModel, camera: object) -> int:
    if isinstance(camera, str):
        kind = int(mujoco.mjtObj.mjOBJ_CAMERA)
        # An empty name would find the first nameless camera.
        index = mujoco.mj_name2id(model, kind, camera) if camera else -1
        if index < 0:
            hint = "Or give -1, the free camera."
            raise UnknownName("camera", camera, camera_names(model), hint=hint)
        return int(index)
    if isinstance(camera, bool) or not isinstance(camera, int | np.integer):
        raise InvalidArgument(
            "A camera is a name, a number or a mujoco.MjvCamera, got "
            f"{camera!r} of type {type(camera).__name__}."
        )
    if not FREE_CAMERA <= camera < model.ncam:
        raise InvalidArgument(
            f"There is no camera number {camera}: this model has {model.ncam} cameras. "
            f"Give a number from -1 (the free camera) to {model.ncam - 1}."
        )
    return int(camera)

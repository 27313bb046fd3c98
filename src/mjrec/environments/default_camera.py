# SPDX-License-Identifier: Apache-2.0
"""Which camera shows a model where nobody asked for one."""

from __future__ import annotations

from typing import Any

from ..simulation.cameras import FREE_CAMERA, raw_model, tracking_camera


def default_camera(model: Any) -> str | int:
    """Return the camera that follows the robot, else the first, else the free one.

    Robots leave the picture of a camera that does not follow them. Where none follows,
    the author's first camera knows more of the scene than MuJoCo's free one.

    Args:
        model: a `mujoco.MjModel` or dm_control's wrapper of one.

    Returns:
        A name, or a number for a camera that has no name; -1 is the free camera.
    """
    tracking = tracking_camera(model)
    if tracking is not None:
        return tracking
    model = raw_model(model)
    return (str(model.camera(0).name) or 0) if model.ncam else FREE_CAMERA

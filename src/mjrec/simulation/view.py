# SPDX-License-Identifier: Apache-2.0
"""The view of a scene in an environment: the camera, the options and the size.

A viewer creates an OpenGL context, but states must be recorded without a context. So
this module sets cameras and options in the same way as the frameworks' viewers.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from ..errors import InvalidArgument
from .fields import apply_fields, empty_model, member_names, read_member

# A scene allocates a quarter of a kilobyte per geom.
_MOST_GEOMS = 1 << 20
# OpenGL's own limits are lower.
_LARGEST = 1 << 16
_LONGEST_LABEL = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneView:
    """Everything that a frame depends on, except the model and data.

    Attributes:
        camera: the environment's own live camera, or a camera created by mjrec.
        option: the visual options, from the environment or from mjrec. They are not
            always MuJoCo's defaults.
        max_geom: maximum number of geoms in the scene; additional geoms are not drawn.
        fresh: whether each frame gets a new scene, as in dm_control. In a reused
            scene, an infinite plane is drawn around the camera of the previous frame.
        height: height of the frames in pixels.
        width: width of the frames in pixels.
        label: the camera in the metadata: a name, a number or a pose.
    """

    camera: mujoco.MjvCamera
    option: mujoco.MjvOption
    max_geom: int
    fresh: bool
    height: int
    width: int
    label: Any

    def facts(self) -> dict[str, Any]:
        """Return the complete view as JSON-compatible values."""
        return {
            "camera": _struct_facts(self.camera),
            "option": _struct_facts(self.option),
            "max_geom": int(self.max_geom),
            "fresh": bool(self.fresh),
            "height": int(self.height),
            "width": int(self.width),
            "label": self.label,
            "previous_cameras": None,
        }


def view_from_facts(facts: Mapping[str, Any]) -> SceneView:
    """Return the view described by the result of `SceneView.facts`.

    Raises:
        InvalidArgument: a value is missing or invalid. The facts may come from a file.
    """
    structs = {"camera": mujoco.MjvCamera(), "option": mujoco.MjvOption()}
    fields = {}
    for what, struct in structs.items():
        values, names = facts.get(what), _names(struct.__class__)
        if not isinstance(values, Mapping) or values.keys() != {*names}:
            raise InvalidArgument(
                f"A {what} needs exactly these values: {', '.join(names)}. It cannot "
                f"be made from {values!r:.200}."
            )
        fields.update({f"{what}.{name}": np.asarray(values[name]) for name in names})
    apply_fields(empty_model(), fields, **structs)
    label = facts.get("label")
    if not isinstance(label, str | int | Mapping) or len(str(label)) > _LONGEST_LABEL:
        raise InvalidArgument(
            f"A label must be a camera's name, number or pose, not {label!r:.50}..."
        )
    return SceneView(
        **structs,
        max_geom=_whole(facts, "max_geom", most=_MOST_GEOMS),
        fresh=facts.get("fresh") is True,
        height=_whole(facts, "height"),
        width=_whole(facts, "width"),
        label=label,
    )


def viewer_option(flags: Mapping[int, bool] | None = None) -> mujoco.MjvOption:
    """Return MuJoCo's default option with some of its flags changed."""
    option = mujoco.MjvOption()
    for flag, value in (flags or {}).items():
        option.flags[flag] = value
    return option


def option_without_rangefinder() -> mujoco.MjvOption:
    """Return dm_control's default option, which differs from MuJoCo's in one flag."""
    return viewer_option({int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER): False})


def place_free_camera(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
    """Move a camera to the free camera's pose in the model's current fields."""
    mujoco.mjv_defaultFreeCamera(model, camera)


def place_viewer_camera(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    config: Mapping[str, Any] | None,
    camera: mujoco.MjvCamera,
) -> None:
    """Place a camera where a newly created Gymnasium viewer would place its own.

    The camera looks at the median of the current geom positions and stays there. So a
    viewer that is created later shows the same state from a different position.

    Args:
        model: the model.
        data: the model's data.
        config: values of the camera's members by name, as environments define them
            (`default_camera_config`).
        camera: the camera to move.
    """
    mujoco.mjv_defaultCamera(camera)
    select_camera(camera, -1)
    # Computed without `np.median`, which imports numpy.ma.
    places = np.sort(data.geom_xpos, axis=0)
    camera.lookat[:] = (places[(len(places) - 1) // 2] + places[len(places) // 2]) / 2
    camera.distance = model.stat.extent
    for name, value in (config or {}).items():
        _assign(camera, name, value)


def select_camera(camera: mujoco.MjvCamera, camera_id: int | None) -> None:
    """Select a camera in a viewer, as Gymnasium does when it renders.

    Args:
        camera: the viewer's camera.
        camera_id: the number of one of the model's cameras; -1 to make the camera free
            without moving it; None to leave the camera unchanged.
    """
    if camera_id is not None:
        kind = "FREE" if camera_id == -1 else "FIXED"
        camera.type = int(mujoco.mjtCamera.__members__[f"mjCAMERA_{kind}"])
        camera.fixedcamid = camera_id


def copy_members(source: Any, target: Any) -> None:
    """Copy all members of one camera or option to another."""
    for name in _names(target.__class__):
        _assign(target, name, getattr(source, name))


def new_scene_flags(model: mujoco.MjModel) -> bytes:
    """Return the rendering flags of a new scene."""
    return bytes(mujoco.MjvScene(model, maxgeom=1).flags.tobytes())


@functools.cache
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(member_names(kind()))


def _assign(struct: object, name: str, value: Any) -> None:
    if isinstance(value, np.ndarray):
        getattr(struct, name)[...] = value
    else:
        setattr(struct, name, value)


def _struct_facts(struct: Any) -> dict[str, Any]:
    return {
        name: read_member(struct, name).tolist() for name in _names(struct.__class__)
    }


def _whole(facts: Mapping[str, Any], name: str, *, most: int = _LARGEST) -> int:
    value = facts.get(name)
    if type(value) is not int or not 1 <= value <= most:
        raise InvalidArgument(
            f"The scene's {name} must be a whole number from 1 to {most}, not "
            f"{value!r:.100}."
        )
    return value

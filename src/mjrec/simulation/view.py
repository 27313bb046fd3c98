# SPDX-License-Identifier: Apache-2.0
"""How an environment shows its scene: the camera, the options, the size.

A viewer makes an OpenGL context, and a recording of states must do without one: cameras
and options are settled here as the frameworks' viewers settle theirs.
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

# A scene's memory is a quarter of a kilobyte for each.
_MOST_GEOMS = 1 << 20
# OpenGL's own limits are below it.
_LARGEST = 1 << 16


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneView:
    """What a frame depends on besides model and data.

    Attributes:
        camera: the environment's own live camera, or one of ours.
        option: likewise the visual options, which are not always MuJoCo's default.
        max_geom: how many geoms the scene may have; the rest is not drawn.
        fresh: whether each frame gets a new scene, as in dm_control. In a scene that
            stays, an infinite plane is drawn around the camera of the frame before.
        height: of the frames, in pixels.
        width: likewise.
        label: what metadata calls the camera: a name, a number, or where it is.
    """

    camera: mujoco.MjvCamera
    option: mujoco.MjvOption
    max_geom: int
    fresh: bool
    height: int
    width: int
    label: Any

    def facts(self) -> dict[str, Any]:
        """Return what JSON can hold of it, all of it."""
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
    """Return the view that `SceneView.facts` has described.

    Raises:
        InvalidArgument: something is missing, or is not what it should be; the facts
            may come from a file.
    """
    structs = {"camera": mujoco.MjvCamera(), "option": mujoco.MjvOption()}
    fields = {}
    for what, struct in structs.items():
        values, names = facts.get(what), _names(struct.__class__)
        if not isinstance(values, Mapping) or values.keys() != {*names}:
            raise InvalidArgument(
                f"A {what} needs exactly these values: {', '.join(names)}; "
                f"got {values!r:.200}."
            )
        fields.update({f"{what}.{name}": np.asarray(values[name]) for name in names})
    apply_fields(empty_model(), fields, **structs)
    return SceneView(
        **structs,
        max_geom=_whole(facts, "max_geom", most=_MOST_GEOMS),
        fresh=facts.get("fresh") is True,
        height=_whole(facts, "height"),
        width=_whole(facts, "width"),
        label=facts.get("label"),
    )


def viewer_option(flags: Mapping[int, bool] | None = None) -> mujoco.MjvOption:
    """Return MuJoCo's default option with some of its flags set."""
    option = mujoco.MjvOption()
    for flag, value in (flags or {}).items():
        option.flags[flag] = value
    return option


def option_without_rangefinder() -> mujoco.MjvOption:
    """Return dm_control's default option, which differs from MuJoCo's in one flag."""
    return viewer_option({int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER): False})


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
    shows another frame of the same state.

    Args:
        model: the model.
        data: its data.
        config: members of the camera by their names, as environments give them
            (`default_camera_config`).
        camera: is put there.
    """
    mujoco.mjv_defaultCamera(camera)
    select_camera(camera, -1)
    # The median, without the numpy.ma that `np.median` imports.
    places = np.sort(data.geom_xpos, axis=0)
    camera.lookat[:] = (places[(len(places) - 1) // 2] + places[len(places) // 2]) / 2
    camera.distance = model.stat.extent
    for name, value in (config or {}).items():
        _assign(camera, name, value)


def select_camera(camera: mujoco.MjvCamera, camera_id: int | None) -> None:
    """Do to a viewer's camera what Gymnasium does when it draws.

    Args:
        camera: of the viewer.
        camera_id: of one of the model's cameras; -1 is a free camera, wherever it is;
            None leaves it as it is.
    """
    if camera_id is not None:
        kind = "FREE" if camera_id == -1 else "FIXED"
        camera.type = int(mujoco.mjtCamera.__members__[f"mjCAMERA_{kind}"])
        camera.fixedcamid = camera_id


def copy_members(source: Any, target: Any) -> None:
    """Make a camera, or an option, say what another of its type says."""
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
            f"{name} of a scene has to be a whole number from 1 to {most}, got "
            f"{value!r:.100}."
        )
    return value

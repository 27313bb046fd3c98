# SPDX-License-Identifier: Apache-2.0
"""A check during recording that a snapshot contains all that the visualizer reads.

MuJoCo may read a field that we do not know about. Building a scene takes microseconds
and needs no OpenGL. So one scene is built from the live data and another from the
restored snapshot, and they must be equal.

Checking one scene is not enough for plugins. For each scene, MuJoCo calls a plugin's
`visualize`, which may draw from the plugin's own memory, and may do so only sometimes:
a touch grid draws nothing until something touches it. So models with plugins are
recorded live.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from .captured_arrays import TENDON_RGBA
from .snapshot import restore_snapshot
from .view import SceneView

_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)

# Members that `mjv_updateScene` does not set for every geom, or that are set later,
# when the geom is drawn.
_NOT_SET = ("camdist", "modelrbound", "transparent")


def scene_difference(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    row: Any,
    view: SceneView,
) -> str | None:
    """Return how a frame from a snapshot would differ from one of the live data.

    Neither the model nor the data is modified.

    Args:
        model: the current model.
        data: the model's data.
        row: a snapshot of the current data.
        view: the camera, options and size of the scene.

    Returns:
        The name of the first difference, or None if the scenes are equal.
    """
    if model.nplugin:
        return "its plugins may draw from their own memory"
    # The tendons' own colours are restored into the model.
    sets_model = TENDON_RGBA in (row.dtype.names or ())
    restored_model = copy.copy(model) if sets_model else model
    restored = mujoco.MjData(restored_model)
    restore_snapshot(row, restored_model, restored)
    live = updated_scene(model, data, view)
    again = updated_scene(restored_model, restored, view)
    return next(differences(live, again, view.option), None)


def updated_scene(
    model: mujoco.MjModel, data: mujoco.MjData, view: SceneView
) -> mujoco.MjvScene:
    """Return a new scene of `data`; the view is not modified."""
    scene = mujoco.MjvScene(model, maxgeom=view.max_geom)
    for name in _shapes():
        # MuJoCo does not initialize the arrays of shapes that are not shown.
        getattr(scene, name)[...] = 0
    # Updating the scene moves a tracking camera.
    camera = copy.copy(view.camera)
    mujoco.mjv_updateScene(model, data, view.option, None, camera, _EVERYTHING, scene)
    return scene


def differences(
    live: mujoco.MjvScene, again: mujoco.MjvScene, option: mujoco.MjvOption
) -> Iterator[str]:
    """Yield the names of the parts of `again` that differ in any bit from `live`."""
    found = dict(_parts(again, option))
    for what, value in _parts(live, option):
        if found.get(what) != value:
            yield what


def _parts(
    scene: mujoco.MjvScene, option: mujoco.MjvOption
) -> Iterator[tuple[str, Any]]:
    """Yield the parts of a scene with their names."""
    is_labelled = option.label != int(mujoco.mjtLabel.mjLABEL_NONE)
    not_set = _NOT_SET if is_labelled else (*_NOT_SET, "label")
    yield "the number of geoms", scene.ngeom
    yield "the number of lights", scene.nlight
    for what, structs in (
        ("geom", scene.geoms[: scene.ngeom]),
        ("light", scene.lights[: scene.nlight]),
        ("camera", scene.camera),
    ):
        for index, struct in enumerate(structs):
            for name in _members(struct.__class__):
                if what != "geom" or name not in not_set:
                    yield f"{name} of {what} {index}", _value(struct, name)
    for name in _shapes():
        yield name, _value(scene, name)


def _value(struct: Any, name: str) -> Any:
    value = getattr(struct, name)
    # Compare bytes, so that NaN equals NaN, and -0.0 differs from 0.0.
    return value.tobytes() if isinstance(value, np.ndarray) else value


@functools.cache
def _members(kind: Any) -> tuple[str, ...]:
    names = (name for name in dir(kind) if not name.startswith("_"))
    return tuple(n for n in names if not callable(getattr(kind, n)))


@functools.cache
def _shapes() -> tuple[str, ...]:
    """Return the names of the arrays with the shapes of skins and flexes."""
    scene = mujoco.MjvScene()
    names = (name for name in dir(scene) if name.startswith(("skin", "flex")))
    values = {name: getattr(scene, name) for name in names}
    return tuple(n for n, v in values.items() if getattr(v, "dtype", None) == "<f4")

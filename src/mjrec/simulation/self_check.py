# SPDX-License-Identifier: Apache-2.0
"""Proof that a snapshot holds what the visualiser reads, on the spot.

MuJoCo may read a field that we do not know of. Putting a scene together needs no OpenGL
and microseconds: one is made from the live data and one from what a snapshot brings
back, and they have to be the same.

One scene does not tell of plugins: MuJoCo calls a plugin's `visualize` for each scene,
and what that draws may come from its own memory and show only at times (a touch grid
draws nothing until something touches it). So models with plugins are recorded live.
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

# Not set by `mjv_updateScene` in every geom, or only later, when it is drawn.
_NOT_SET = ("camdist", "modelrbound", "transparent")


def scene_difference(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    row: Any,
    view: SceneView,
) -> str | None:
    """Say in what the frame of a snapshot would differ from the one of the live data.

    Neither model nor data is written to.

    Args:
        model: the model of this moment.
        data: its data.
        row: the snapshot of this moment.
        view: how the scene is shown.

    Returns:
        What differs, in words; None where the scenes are the same.
    """
    if model.nplugin:
        return "its plugins may draw by themselves, from what they alone know"
    # Where tendons have colours of their own these are set in the model.
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
    """Return a new scene of `data`; the view is left as it is."""
    scene = mujoco.MjvScene(model, maxgeom=view.max_geom)
    for name in _shapes():
        # What is not shown is not set either, and may be anything.
        getattr(scene, name)[...] = 0
    # A camera that follows something is moved by what it follows.
    camera = copy.copy(view.camera)
    mujoco.mjv_updateScene(model, data, view.option, None, camera, _EVERYTHING, scene)
    return scene


def differences(
    live: mujoco.MjvScene, again: mujoco.MjvScene, option: mujoco.MjvOption
) -> Iterator[str]:
    """Yield in words what of `again` is not, to the last bit, as in `live`."""
    found = dict(_parts(again, option))
    for what, value in _parts(live, option):
        if found.get(what) != value:
            yield what


def _parts(
    scene: mujoco.MjvScene, option: mujoco.MjvOption
) -> Iterator[tuple[str, Any]]:
    """Yield what a scene consists of, by what it is called."""
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
    # By bytes: a NaN is the same as a NaN, and -0.0 is not 0.0.
    return value.tobytes() if isinstance(value, np.ndarray) else value


@functools.cache
def _members(kind: Any) -> tuple[str, ...]:
    names = (name for name in dir(kind) if not name.startswith("_"))
    return tuple(n for n in names if not callable(getattr(kind, n)))


@functools.cache
def _shapes() -> tuple[str, ...]:
    """Return the names of the arrays that hold the shapes of skins and flexes."""
    scene = mujoco.MjvScene()
    names = (name for name in dir(scene) if name.startswith(("skin", "flex")))
    values = {name: getattr(scene, name) for name in names}
    return tuple(n for n, v in values.items() if getattr(v, "dtype", None) == "<f4")

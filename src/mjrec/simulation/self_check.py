# SPDX-License-Identifier: Apache-2.0
"""Proof that a snapshot holds what the visualiser reads, on the spot.

MuJoCo may read a field that we do not know of. Putting a scene together needs no OpenGL
and microseconds: one is made from the live data and one from what a snapshot brings
back, and they have to be the same.

One scene does not tell of plugins: MuJoCo calls a plugin's `visualize` for each scene,
and what that draws may come from its own memory and show only at times (a touch grid
draws nothing until something touches it). So they are asked for by name.
"""

from __future__ import annotations

import copy
import ctypes
import functools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from .captured_arrays import TENDON_RGBA
from .snapshot import restore_snapshot
from .view import SceneView

_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)

# Not set by `mjv_updateScene` in every geom, or only later, when it is drawn.
_NOT_SET = ("camdist", "modelrbound", "transparent", "label")


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
    plugin = drawing_plugin(model)
    if plugin is not None:
        return f"the plugin {plugin} draws by itself, from what it alone knows"
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
    if live.ngeom != again.ngeom:
        yield f"{again.ngeom} geoms instead of {live.ngeom}"
    if live.nlight != again.nlight:
        yield f"{again.nlight} lights instead of {live.nlight}"
    labelled = option.label != int(mujoco.mjtLabel.mjLABEL_NONE)
    without = tuple(n for n in _NOT_SET if not (labelled and n == "label"))
    geoms = slice(min(live.ngeom, again.ngeom))
    lights = slice(min(live.nlight, again.nlight))
    yield from _different("geom", live.geoms[geoms], again.geoms[geoms], without)
    yield from _different("light", live.lights[lights], again.lights[lights])
    yield from _different("camera", live.camera, again.camera)
    for name in _shapes():
        if _value(live, name) != _value(again, name):
            yield f"the scene's {name}"


def _different(
    what: str,
    live: Iterable[Any],
    again: Iterable[Any],
    without: tuple[str, ...] = (),
) -> Iterator[str]:
    for index, (one, other) in enumerate(zip(live, again, strict=True)):
        names = [n for n in _members(one.__class__) if n not in without]
        differing = [n for n in names if _value(one, n) != _value(other, n)]
        if differing:
            yield f"{', '.join(differing)} of {what} {index} of the scene"


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


class _Plugin(ctypes.Structure):
    """The beginning of `mjpPlugin` (mjplugin.h), the same from mujoco 3.3 to 4.0."""

    _functions = (
        *("nstate", "nsensordata", "init", "destroy", "copy", "reset"),
        *("compute", "advance", "visualize"),
    )
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("nattribute", ctypes.c_int),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", ctypes.c_int),
        ("needstage", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in _functions),
    )


def drawing_plugin(model: mujoco.MjModel) -> str | None:
    """Return the name of a plugin of `model` that draws; None where there is none.

    A plugin that cannot be looked at counts as one that draws.
    """
    for instance in range(model.nplugin):
        try:
            plugin = _library().mjp_getPluginAtSlot(int(model.plugin[instance]))[0]
        except (OSError, AttributeError, ValueError):
            return f"number {instance}, which cannot be looked at,"
        if plugin.visualize:
            return str((plugin.name or b"").decode(errors="replace"))
    return None


@functools.cache
def _library() -> Any:
    # Loaded already; this only finds it again.
    path = next(Path(mujoco.__file__).parent.glob("libmujoco.*"), None)
    library = ctypes.CDLL(None if path is None else str(path))
    library.mjp_getPluginAtSlot.restype = ctypes.POINTER(_Plugin)
    library.mjp_getPluginAtSlot.argtypes = [ctypes.c_int]
    return library

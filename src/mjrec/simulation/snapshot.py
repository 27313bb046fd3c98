# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a simulation, taken as rows of bytes and restored for drawing.

A snapshot that is restored into a new `MjData` yields the same scene, byte for byte.
This is checked during recording, because MuJoCo may read a field that we do not know
about. Building a scene takes microseconds and needs no OpenGL. So one scene is built
from the live data and another from the restored snapshot, and they must be equal.

Checking one scene is not enough for plugins. For each scene, MuJoCo calls a plugin's
`visualize`, which may draw from the plugin's own memory, but not in every scene: a
touch grid draws nothing until something touches it. So models with plugins are recorded
live.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from .captured_arrays import ALWAYS, SNAPSHOT_ARRAYS, TENDON_RGBA, array_kind
from .raw_memory import WORDS, can_be_gathered, words_of
from .view import SceneView

# Arrays of indices into the geoms and into each other, which the visualizer does not
# check.
_PATHS = ("ten_wrapadr", "ten_wrapnum", "wrap_obj")
# This value takes the place of a geom's index.
_PULLEY = -2

_LIMIT_TENDON = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
_TENDON = int(mujoco.mjtObj.mjOBJ_TENDON)
_DYNAMIC = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)

# Members that `mjv_updateScene` does not set for every geom, or that are set later,
# when the geom is drawn.
_NOT_SET = ("camdist", "modelrbound", "transparent")


class SnapshotSource:
    """A source of snapshots from one `MjData`.

    Args:
        model: the model, which is kept alive, like the data.
        data: the model's data.
        kind: the dtype that `snapshot_dtype` returned for the model.

    Attributes:
        words: the snapshot's indices in `raw_memory.WORDS`; None if the snapshot cannot
            be gathered, or if it includes arrays from outside the data.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, kind: np.dtype[Any]
    ) -> None:
        self._kind = kind
        self._colours: TendonColours | None = None
        arrays = []
        for name in kind.names or ():
            if name == TENDON_RGBA:
                self._colours = TendonColours(model, data)
                arrays.append(self._colours.rgba)
            else:
                arrays.append(getattr(data, name))
        # These references keep the data alive.
        self._arrays = arrays
        self._words = words_of(arrays) if can_be_gathered(arrays) else None
        self.words = self._words if self._colours is None else None

    def take(self, out: NDArray[np.uint64]) -> None:
        """Write a snapshot of the current data into `out`, filling all of its words."""
        if self._colours is not None:
            self._colours.update()
        if self._words is not None:
            WORDS.take(self._words, None, out, "clip")
            return
        row = out.view(self._kind)
        for name, array in zip(self._kind.names or (), self._arrays, strict=True):
            row[name] = array

    def taken(self) -> Any:
        """Return a snapshot of the current data; its members are MuJoCo's arrays."""
        words = np.zeros(self._kind.itemsize // 8, np.uint64)
        self.take(words)
        return words.view(self._kind)[0]


class TendonColours:
    """The colors in which a model's tendons are drawn.

    If a spatial tendon is at its limit, MuJoCo blends its color with the color of
    constraints, weighted by the strength of the limit. Tendons with a material or a
    color of their own are not blended. The strength is not kept after the step, so the
    resulting color is recorded. It is read from a scene that contains only the
    tendons.

    Attributes:
        rgba: `(ntendon, 4) float32`, set by `update`; always the same array.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model = model
        self._data = data
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        for groups in (self._option.geomgroup, self._option.sitegroup):
            groups[:] = 0
        self._option.tendongroup[:] = 1
        self._option.flags[:] = 0
        self._option.flags[int(mujoco.mjtVisFlag.mjVIS_TENDON)] = 1
        segments = 2 * model.nwrap + model.ntendon * (model.vis.quality.numslices + 1)
        self._scene = mujoco.MjvScene(model, maxgeom=segments + 100)
        self.rgba = np.array(model.tendon_rgba)

    def update(self) -> None:
        """Bring `rgba` up to date with the model and data."""
        model, data = self._model, self._data
        self.rgba[:] = model.tendon_rgba
        limits = slice(data.ne + data.nf, data.ne + data.nf + data.nl)
        if not data.nl or not (data.efc_type[limits] == _LIMIT_TENDON).any():
            return
        mujoco.mjv_updateScene(
            *(model, data, self._option, None, self._camera, _DYNAMIC, self._scene)
        )
        plain = model.tendon_matid < 0
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == _TENDON and plain[geom.objid]:
                self.rgba[geom.objid] = geom.rgba


def check_layout(
    model: mujoco.MjModel, data: mujoco.MjData, kind: np.dtype[Any]
) -> None:
    """Check that recorded snapshots belong to this model, before they are restored.

    They must contain at least the arrays that MuJoCo's default option needs.

    Raises:
        InvalidArgument: the snapshots belong to another model or version of MuJoCo.
    """
    for name in kind.names or ():
        is_colour = name == TENDON_RGBA
        if not is_colour and name not in SNAPSHOT_ARRAYS:
            raise InvalidArgument(
                f"The snapshots contain {name!r:.40}, which is not used for drawing."
            )
        own = array_kind(model if is_colour else data, name)
        if kind[name] != own:
            raise InvalidArgument(
                f"The snapshots' {name} is {kind[name]}, but it must be {own}. They "
                "belong to another model or version of MuJoCo."
            )
    held = {*(kind.names or ())}
    missing = {name for name in ALWAYS if array_kind(data, name) is not None} - held
    if missing:
        raise InvalidArgument(f"The snapshots lack {', '.join(sorted(missing))}.")


def restore_snapshot(row: Any, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Restore a snapshot into `data` for use with `mjv_updateScene`.

    Args:
        row: an element of `TrajectoryReader.snapshots`, whose layout was checked.
        model: the model. Its tendons' colors are set if `row` has them.
        data: the model's data.

    Raises:
        InvalidArgument: a tendon refers to something that is not in the model, which
            MuJoCo would not detect.
    """
    names = row.dtype.names or ()
    for name in names:
        target = model if name == TENDON_RGBA else data
        getattr(target, name)[...] = row[name]
    if not {*_PATHS}.isdisjoint(names):
        _check_paths(model, data)


def _check_paths(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check the indices along tendons, which the visualizer uses without checks."""
    first, count = data.ten_wrapadr.astype(np.int64), data.ten_wrapnum
    points, wrapped = 2 * model.nwrap, data.wrap_obj
    ends = first + count
    if ((count < 0) | (first < 0) | (ends > points))[count != 0].any():
        raise InvalidArgument(
            f"The snapshot's tendons use points up to {ends.max()}, but this model has "
            f"only {points}. The snapshot belongs to another model, or is damaged."
        )
    if wrapped.size and (wrapped.min() < _PULLEY or wrapped.max() >= model.ngeom):
        raise InvalidArgument(
            f"The snapshot's wrap_obj must be {_PULLEY} (a pulley), -1 (a site) or a "
            f"geom's number up to {model.ngeom - 1} for this model, but its values "
            f"range from {wrapped.min()} to {wrapped.max()}."
        )


def scene_difference(
    model: mujoco.MjModel, data: mujoco.MjData, row: Any, view: SceneView
) -> str | None:
    """Return how a frame drawn from a snapshot would differ from a live one.

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
    # The tendons' own colors are restored into the model.
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

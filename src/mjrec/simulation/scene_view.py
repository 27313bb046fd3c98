# SPDX-License-Identifier: Apache-2.0
"""How an environment shows its scene: the camera, the options, the size."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from .struct_memory import (
    Members,
    Memory,
    Place,
    array_address,
    find_places,
    kind_of,
    member_names,
    read_member,
)

# A scene's memory is a quarter of a kilobyte for each.
_MOST_GEOMS = 1 << 20
# OpenGL's own limits are below it.
_LARGEST = 1 << 16


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneView:
    """What a picture depends on besides model and data.

    Attributes:
        camera: the environment's own live camera, or one of ours.
        option: likewise the visual options, which are not always MuJoCo's default.
        max_geom: how many geoms the scene may have; the rest is not drawn.
        fresh: whether each picture gets a new scene, as in dm_control. In a scene that
            stays, an infinite plane is drawn around the camera of the picture before.
        height: of the pictures, in pixels.
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


def scene_view_from_facts(facts: Mapping[str, Any]) -> SceneView:
    """Return the view that `SceneView.facts` has described.

    Raises:
        InvalidArgument: something is missing, or is not what it should be; the facts
            may come from a file.
    """
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    _set_struct(camera, facts.get("camera"), "camera")
    _set_struct(option, facts.get("option"), "option")
    return SceneView(
        camera=camera,
        option=option,
        max_geom=_whole(facts, "max_geom", most=_MOST_GEOMS),
        fresh=facts.get("fresh") is True,
        height=_whole(facts, "height"),
        width=_whole(facts, "width"),
        label=facts.get("label"),
    )


class ViewMemory:
    """Notices when somebody moves the camera or sets an option of a view.

    Args:
        view: whose objects are watched, and kept alive.

    Attributes:
        seen: camera and option as they were when last asked.
        present: the same as they are: where the lists are equal, nothing has changed.
    """

    def __init__(self, view: SceneView) -> None:
        self._structs = {"camera": view.camera, "option": view.option}
        self._memory = {
            name: _memory_of(struct) for name, struct in self._structs.items()
        }
        self.seen = [memory.copy() for memory in self._memory.values()]
        self.present = [memory.raw for memory in self._memory.values()]

    def changed(self) -> dict[str, NDArray[Any]] | None:
        """Return what is other than when last asked, as `camera.lookat` and so on.

        Returns:
            Copies by their names; None, at once, where all is the same.
        """
        if self.seen == self.present:
            return None
        fields = {}
        for seen, (name, memory) in zip(self.seen, self._memory.items(), strict=True):
            for member in memory.differing(seen):
                value = read_member(self._structs[name], member)
                fields[f"{name}.{member}"] = value
            # In place: somebody may hold it.
            seen[:] = memory.copy()
        return fields or None


@functools.cache
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(member_names(kind()))


def _struct_facts(struct: Any) -> dict[str, Any]:
    names = _names(kind_of(struct))
    return {name: read_member(struct, name).tolist() for name in names}


def _set_struct(struct: Any, values: object, what: str) -> None:
    names = _names(kind_of(struct))
    if not isinstance(values, Mapping) or values.keys() != set(names):
        raise InvalidArgument(
            f"A {what} needs exactly these values: {', '.join(names)}; "
            f"got {values!r:.200}."
        )
    for name in names:
        _set_member(struct, name, values[name], what)


# The visualiser looks these up in tables of its own, without a look at their bounds.
_KINDS = {
    "label": int(mujoco.mjtLabel.mjNLABEL),
    "frame": int(mujoco.mjtFrame.mjNFRAME),
}


def _set_member(struct: object, name: str, value: Any, what: str) -> None:
    present = getattr(struct, name)
    given = np.asarray(value)
    if given.dtype.kind not in "iuf" or given.shape != np.shape(present):
        raise InvalidArgument(
            f"{name} of a {what} has to be numbers of the shape {np.shape(present)} in "
            f"MuJoCo {mujoco.__version__}, got {value!r:.200}."
        )
    if name in _KINDS and given.item() not in range(_KINDS[name]):
        raise InvalidArgument(
            f"{name} of a {what} has to be from 0 to {_KINDS[name] - 1} in MuJoCo "
            f"{mujoco.__version__}, got {value!r:.200}."
        )
    if isinstance(present, np.ndarray):
        present[...] = given
    else:
        setattr(struct, name, type(present)(given.item()))


def _whole(facts: Mapping[str, Any], name: str, *, most: int = _LARGEST) -> int:
    value = facts.get(name)
    if type(value) is not int or not 1 <= value <= most:
        raise InvalidArgument(
            f"{name} of a scene has to be a whole number from 1 to {most}, got "
            f"{value!r:.100}."
        )
    return value


# How far a camera and an option reach before their first and behind their last array.
# Nothing beyond is looked at: it belongs to somebody else, and may change any time.
_REACH = {mujoco.MjvCamera: (16, 32), mujoco.MjvOption: (8, 8)}


def _memory_of(struct: Any) -> Memory | Members:
    names = list(_names(kind_of(struct)))
    found = _places(kind_of(struct))
    if found is None:
        return Members(struct, names)
    offset, places = found
    return Memory(_span_of_arrays(struct)[0] + offset, list(places))


@functools.cache
def _places(kind: Any) -> tuple[int, tuple[Place, ...]] | None:
    """Return where a struct begins, from its first array on, and its members."""
    struct = kind()
    first, last = _span_of_arrays(struct)
    before, behind = _REACH[kind]
    start, stop = first - before, last + -last % 4 + behind
    places = find_places(struct, list(_names(kind)), start=start, stop=stop)
    return None if places is None else (-before, tuple(places))


def _span_of_arrays(struct: Any) -> tuple[int, int]:
    values = [getattr(struct, name) for name in _names(kind_of(struct))]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    starts = [array_address(array) for array in arrays]
    stops = [array_address(array) + array.nbytes for array in arrays]
    return min(starts), max(stops)

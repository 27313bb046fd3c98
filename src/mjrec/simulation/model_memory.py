# SPDX-License-Identifier: Apache-2.0
"""What of a model has changed, found by comparing memory.

Comparing some five hundred arrays one by one takes longer than a simulation step. They
all lie in one allocation, and the structs `opt`, `vis` and `stat` one behind the other
in `mjModel` itself, so a handful of comparisons of long pieces tells that nothing has
changed, which is usual; only a piece that differs is looked at by name. Both facts are
checked, not believed: where they do not hold, each array is a piece of its own.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
from numpy.typing import NDArray

from .model_fields import array_names, empty_model, read_fields, struct_names
from .struct_memory import Members, Memory, Place, array_address, find_places

# What MuJoCo's visualiser reads of a model whenever it makes a scene (traced in 3.17
# and 4.0). These are compared at every captured step, the others at every reset.
_SHOWN = frozenset(
    (
        *("geom_size", "geom_rgba", "geom_matid", "geom_group", "geom_type"),
        *("geom_dataid", "geom_rbound", "geom_bodyid", "geom_castshadow"),
        *("body_weldid", "mesh_graphadr", "mesh_texcoordadr"),
        *("site_size", "site_rgba", "site_matid", "site_group", "site_type"),
        *("site_bodyid", "site_dataid"),
        *("mat_rgba", "mat_emission", "mat_specular", "mat_shininess"),
        *("mat_reflectance", "mat_metallic", "mat_roughness"),
        *("mat_texid", "mat_texrepeat", "mat_texuniform"),
        *("light_active", "light_type", "light_texid", "light_castshadow"),
        *("light_bulbradius", "light_intensity", "light_range", "light_attenuation"),
        *("light_cutoff", "light_exponent", "light_softness"),
        *("light_ambient", "light_diffuse", "light_specular"),
        *("cam_fovy", "cam_ipd", "cam_projection", "cam_sensorsize"),
        *("cam_intrinsic", "cam_resolution", "cam_output"),
        *("tendon_rgba", "tendon_width", "tendon_matid", "tendon_group"),
        *("tendon_num", "tendon_range", "tendon_limited", "tendon_lengthspring"),
        *("tendon_stiffness", "tendon_stiffnesspoly", "tendon_damping"),
        *("tendon_dampingpoly", "tendon_frictionloss", "tendon_plasticadr"),
        *("actuator_trntype", "actuator_trnid", "actuator_cranklength"),
        *("skin_rgba", "skin_matid", "skin_group", "skin_inflate"),
        *("skin_bonebindpos", "skin_bonebindquat", "skin_bonebodyid"),
        *("flex_rgba", "flex_matid", "flex_group", "flex_radius", "flex_flatskin"),
        *("sensor_type", "sensor_adr", "sensor_objid", "sensor_objtype"),
        "sensor_intprm",
    )
)
# Between two that are shown so much of what is not is compared with them.
_LONGEST_GAP = 512

# Where the structs are looked for: they lie between the sizes, at the beginning of
# `mjModel`, and the pointers to its arrays.
_MARGIN = 64
_LONGEST_HEAD = 16384


class ModelMemory:
    """Remembers a model, and tells which of its fields have changed since.

    Any field counts at a reset; in between those that pictures depend on do, but for
    what is long and has to be uploaded to the graphics card. The model is kept alive.

    Args:
        model: the model, which is only read.

    Attributes:
        model: the model.
        seen: what is watched, in pieces, as it was when last looked at.
        present: the same pieces as they are: where the lists are equal, nothing of
            what is watched has changed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._address = model._address
        pieces = [*_array_pieces(model), _struct_piece(model)]
        self._light = [piece for piece in pieces if piece.is_watched]
        self._heavy = [piece for piece in pieces if not piece.is_watched]
        # For the comparison at every captured step, which is one of two lists.
        self.seen = [piece.seen for piece in self._light]
        self.present = [piece.raw for piece in self._light]
        # For that at every reset, likewise.
        self._stored = [piece.stored for piece in pieces]
        self._whole = [piece.raw for piece in pieces]
        self._is_as_stored = True

    def is_of(self, model: mujoco.MjModel) -> bool:
        """Tell whether `model` is the model remembered, in whatever wrapper."""
        # The address is of no other model while this one is kept alive.
        return bool(model._address == self._address)

    def changed_from_stored(self) -> dict[str, NDArray[Any]]:
        """Return the fields that are other than when this was made, by their names.

        What is there now counts as seen.
        """
        if self._is_as_stored and self._stored == self._whole:
            return {}
        pieces = [*self._light, *self._heavy]
        names = [name for piece in pieces for name in piece.look_from_stored()]
        self._is_as_stored = not names
        return read_fields(self.model, names)

    def is_unchanged(self) -> bool:
        """Tell whether all that is watched is as it was when last looked at."""
        return self.seen == self.present

    def changed(self) -> dict[str, NDArray[Any]] | None:
        """Return the watched fields that are other than when last looked at.

        Returns:
            Copies by their names; None, in a microsecond, where all are the same.
        """
        return None if self.is_unchanged() else self._looked_at(self._light)

    def anything_changed(self) -> dict[str, NDArray[Any]] | None:
        """Return what `changed` does, of all fields: textures, meshes, masses ..."""
        return self._looked_at([*self._light, *self._heavy])

    def _looked_at(self, pieces: Iterable[_Piece]) -> dict[str, NDArray[Any]] | None:
        self._is_as_stored = False
        names = [name for piece in pieces for name in piece.look()]
        return read_fields(self.model, names) or None


class _Piece:
    """A piece of memory, as it was stored and as it was last seen.

    Args:
        memory: a `Memory`, or the `Members` that stand in for one.
        is_watched: compared at every captured step; of others one copy is kept until
            they change.
    """

    def __init__(self, memory: Memory | Members, *, is_watched: bool = True) -> None:
        self.is_watched = is_watched
        self.raw = memory.raw
        self._memory = memory
        self.stored = memory.copy()
        self.seen = memory.copy() if is_watched else self.stored

    def look_from_stored(self) -> list[str]:
        """Return the names of what is other than when this was made."""
        if self.stored == self.raw:
            if self.seen != self.stored:
                self._see(self.stored)
            return []
        self._see(self._memory.copy())
        return self._memory.differing(self.stored)

    def look(self) -> list[str]:
        """Return the names of what has changed since the last look."""
        if self.seen == self.raw:
            return []
        names = self._memory.differing(self.seen)
        self._see(self._memory.copy())
        return names

    def _see(self, present: bytearray) -> None:
        if self.is_watched:
            # In place: `ModelMemory` holds it.
            self.seen[:] = present
        else:
            self.seen = present


def _array_pieces(model: mujoco.MjModel) -> Iterator[_Piece]:
    """Yield pieces of memory that together hold all arrays."""
    arrays = _arrays_by_address(model)
    if not _lie_together(model, arrays):
        for name, array in arrays:
            yield _Piece(_memory_of([(name, array)]), is_watched=name in _SHOWN)
        return
    watched: list[tuple[str, NDArray[Any]]] = []
    unwatched: list[tuple[str, NDArray[Any]]] = []
    for name, array in arrays:
        if name not in _SHOWN:
            unwatched.append((name, array))
            continue
        if watched and sum(each.nbytes for _, each in unwatched) <= _LONGEST_GAP:
            watched += unwatched
        else:
            yield from _pieces(watched, unwatched)
            watched = []
        watched.append((name, array))
        unwatched = []
    yield from _pieces(watched, unwatched)


def _pieces(
    watched: list[tuple[str, NDArray[Any]]], unwatched: list[tuple[str, NDArray[Any]]]
) -> Iterator[_Piece]:
    if watched:
        yield _Piece(_memory_of(watched))
    if unwatched:
        yield _Piece(_memory_of(unwatched), is_watched=False)


def _arrays_by_address(model: mujoco.MjModel) -> list[tuple[str, NDArray[Any]]]:
    arrays = ((name, getattr(model, name)) for name in array_names())
    filled = (pair for pair in arrays if pair[1].nbytes)
    return sorted(filled, key=lambda pair: array_address(pair[1]))


def _lie_together(
    model: mujoco.MjModel, arrays: list[tuple[str, NDArray[Any]]]
) -> bool:
    """Tell whether all memory between the first and the last array is the model's."""
    if not arrays:
        return False
    first, last = arrays[0][1], arrays[-1][1]
    extent = array_address(last) + last.nbytes - array_address(first)
    return bool(extent <= model.nbuffer)


def _memory_of(arrays: list[tuple[str, NDArray[Any]]]) -> Memory:
    start = array_address(arrays[0][1])
    places = []
    for name, array in arrays:
        offset = array_address(array) - start
        places.append(Place(name, offset, offset + array.nbytes))
    return Memory(start, places)


def _struct_piece(model: mujoco.MjModel) -> _Piece:
    found = _struct_places()
    if found is None:
        return _Piece(Members(model, list(struct_names())))
    offset, places = found
    return _Piece(Memory(model._address + offset, places))


@functools.cache
def _struct_places() -> tuple[int, list[Place]] | None:
    """Return where `opt`, `vis` and `stat` begin in `mjModel`, and their members."""
    model = copy.copy(empty_model())
    center = model.stat.center
    # Behind the last member are the pointers to the arrays, which are longer than this.
    stop = array_address(center) + center.nbytes + _MARGIN
    if not 0 < stop - model._address < _LONGEST_HEAD:
        return None
    places = find_places(model, list(struct_names()), start=model._address, stop=stop)
    if not places:
        return None
    first = places[0].start
    moved = [Place(p.name, p.start - first, p.stop - first) for p in places]
    return first, moved

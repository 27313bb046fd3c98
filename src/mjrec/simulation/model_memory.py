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

__all__ = ["ModelMemory"]

# Too long to compare at every step, and changed by nobody without saying so: what they
# hold has to be uploaded to the graphics card, or belongs to a mesh.
_HEAVY_NAMES = (
    *("tex_data", "hfield_data"),
    *("mesh_vert", "mesh_normal", "mesh_texcoord", "mesh_graph"),
    *("mesh_face", "mesh_facenormal", "mesh_facetexcoord"),
    *("mesh_polynormal", "mesh_polyvertadr", "mesh_polyvertnum", "mesh_polyvert"),
    *("mesh_polymapadr", "mesh_polymapnum", "mesh_polymap"),
    *("skin_vert", "skin_texcoord", "skin_face"),
    *("skin_bonevertid", "skin_bonevertweight"),
    *("bvh_depth", "bvh_child", "bvh_nodeid", "bvh_aabb"),
    *("oct_depth", "oct_child", "oct_aabb", "oct_coeff"),
)
# A short one is compared with the rest, whatever it is.
_HEAVY_BYTES = 4096

# Where the structs are looked for: they lie between the sizes, at the beginning of
# `mjModel`, and the pointers to its arrays.
_MARGIN = 64
_LONGEST_HEAD = 16384


class ModelMemory:
    """Remembers a model, and tells which of its fields have changed since.

    Any field counts, also those that no picture depends on. The model is kept alive.

    Args:
        model: the model, which is only read.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._address = model._address
        pieces = [*_array_pieces(model), _struct_piece(model)]
        self._light = [piece for piece in pieces if not piece.heavy]
        self._heavy = [piece for piece in pieces if piece.heavy]
        # Pairs for the comparison at every captured step.
        self._compared = [(piece.seen, piece.raw) for piece in self._light]

    def is_of(self, model: mujoco.MjModel) -> bool:
        """Tell whether `model` is the model remembered, in whatever wrapper."""
        # The address is of no other model while this one is kept alive.
        return bool(model._address == self._address)

    def changed_from_stored(self) -> dict[str, NDArray[Any]]:
        """Return the fields that are other than when this was made, by their names.

        What is there now counts as seen.
        """
        pieces = [*self._light, *self._heavy]
        names = [name for piece in pieces for name in piece.look_from_stored()]
        return read_fields(self.model, names)

    def changed(self) -> dict[str, NDArray[Any]] | None:
        """Return the light fields that are other than when last looked at.

        Returns:
            Copies by their names; None, in a microsecond, where all are the same.
        """
        for seen, raw in self._compared:
            if seen != raw:
                return self._looked_at(self._light)
        return None

    def anything_changed(self) -> dict[str, NDArray[Any]] | None:
        """Return what `changed` does, of all fields: textures and meshes as well."""
        return self._looked_at([*self._light, *self._heavy])

    def _looked_at(self, pieces: Iterable[_Piece]) -> dict[str, NDArray[Any]] | None:
        names = [name for piece in pieces for name in piece.look()]
        return read_fields(self.model, names) or None


class _Piece:
    """A piece of memory, as it was stored and as it was last seen.

    Args:
        memory: a `Memory`, or the `Members` that stand in for one.
        heavy: long, and a single array; one copy is kept of it until it changes.
    """

    def __init__(self, memory: Memory | Members, *, heavy: bool = False) -> None:
        self.heavy = heavy
        self.raw = memory.raw
        self._memory = memory
        self._stored = memory.copy()
        self.seen = self._stored if heavy else memory.copy()

    def look_from_stored(self) -> list[str]:
        """Return the names of what is other than when this was made."""
        if self._stored == self.raw:
            self._see(self._stored)
            return []
        self._see(self._memory.copy())
        return self._memory.differing(self._stored)

    def look(self) -> list[str]:
        """Return the names of what has changed since the last look."""
        if self.seen == self.raw:
            return []
        names = self._memory.differing(self.seen)
        self._see(self._memory.copy())
        return names

    def _see(self, present: bytearray) -> None:
        if self.heavy:
            self.seen = present
        else:
            # In place: `ModelMemory` holds it.
            self.seen[:] = present


def _array_pieces(model: mujoco.MjModel) -> Iterator[_Piece]:
    """Yield pieces of memory that together hold all arrays."""
    arrays = _arrays_by_address(model)
    together = _lie_together(model, arrays)
    run: list[tuple[str, NDArray[Any]]] = []
    for name, array in arrays:
        heavy = name in _HEAVY_NAMES and array.nbytes > _HEAVY_BYTES
        if run and (heavy or not together):
            yield _Piece(_memory_of(run))
            run = []
        if heavy:
            yield _Piece(_memory_of([(name, array)]), heavy=True)
        else:
            run.append((name, array))
    if run:
        yield _Piece(_memory_of(run))


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

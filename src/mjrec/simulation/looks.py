# SPDX-License-Identifier: Apache-2.0
"""Changes in a model and its view, found by comparing memory.

Comparing some 500 arrays one by one takes longer than a simulation step. But all arrays
are in one allocation, and the structs `opt`, `vis` and `stat` follow one another in
`mjModel` itself. So comparing a few long pieces is enough to show that nothing has
changed, which is the usual case. Only a piece that differs is examined field by field.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .fields import array_names, member_names, read_fields, struct_names
from .raw_memory import address_of, raw_memory
from .view import SceneView

# The groups of arrays that each frame is drawn from. Comparing a few long pieces is
# faster than comparing only the necessary arrays. Other arrays are compared at resets.
_DRAWN = (
    *("geom_", "site_", "mat_", "light_", "cam_", "tendon_", "actuator_cranklength"),
    *("skin_matid", "skin_group", "skin_rgba", "skin_inflate"),
    *("flex_matid", "flex_group", "flex_rgba", "flex_radius"),
)

# Numbers of bytes in a camera and an option before the first and after the last array.
# Memory outside this range belongs to other objects and may change at any time, so it
# is not compared.
_REACH = {mujoco.MjvCamera: (16, 32), mujoco.MjvOption: (8, 8)}

_Arrays = list[tuple[str, NDArray[Any]]]


class Looks:
    """A record of the fields of a model and a view, for finding the changed fields.

    At a reset, all fields of the model are compared. Between resets, only the fields
    used for each frame are compared. They do not include textures and meshes, which
    must be uploaded to the graphics card. The model is not modified, and it is kept
    alive.

    Args:
        model: the model in its currently stored form.

    Attributes:
        seen: the watched memory in pieces, as of the last look. `follow` may replace
            the list; its pieces are changed in place.
        present: the same pieces as they are now. If the two lists are equal, nothing
            watched has changed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._watched: list[_Piece] = [_structs_of(model)]
        self._others: list[_Piece] = []
        for is_watched, arrays in _pieces(model):
            pieces = self._watched if is_watched else self._others
            pieces.append(_ArrayPiece(arrays, is_watched=is_watched))
        self._view: list[_Piece] = []
        self._structs: dict[str, Any] = {}
        self.seen: list[bytearray] = []
        self.present: list[Any] = []

    def is_of(self, model: mujoco.MjModel) -> bool:
        """Return whether `model` is, or wraps, the remembered model."""
        # No other model can have this address while this one is kept alive.
        return bool(model._address == self._model._address)

    def follow(self, view: SceneView) -> None:
        """Watch the camera and the option of a view from now on."""
        structs = {"camera": view.camera, "option": view.option}
        if all(self._structs.get(name) is struct for name, struct in structs.items()):
            for piece in self._view:
                piece.look()
            return
        self._structs = structs
        self._view = [_struct_of_view(*item) for item in structs.items()]
        watched = [*self._watched, *self._view]
        self.seen = [piece.seen for piece in watched]
        self.present = [piece.raw for piece in watched]

    def view_bytes(self) -> bytes:
        """Return the camera and the option as bytes."""
        return b"".join(bytes(piece.raw) for piece in self._view)

    def option_bytes(self) -> bytes:
        """Return the option as bytes."""
        return bytes(self._view[1].raw)

    def since_stored(self) -> dict[str, NDArray[Any]]:
        """Return the model's fields that have changed since this object was created.

        The current values become the values of the last look.
        """
        names: list[str] = []
        for piece in (*self._watched, *self._others):
            names += piece.look_from_stored()
        return read_fields(self._model, names)

    def changed(self, *, anything: bool = False) -> dict[str, NDArray[Any]] | None:
        """Return the watched fields that have changed since the last look.

        Args:
            anything: whether to also compare textures, meshes and so on.

        Returns:
            Copies by name, or None if nothing has changed. In that case, the call takes
            less than a microsecond.
        """
        if not anything and self.seen == self.present:
            return None
        pieces = [*self._watched, *self._view, *(self._others if anything else ())]
        names = (name for piece in pieces for name in piece.look())
        return read_fields(self._model, names, **self._structs) or None


class _Piece:
    """A piece of memory, with its bytes at the start (`stored`) and last look (`seen`).

    Memory that is not watched at each step may be large, so the two share one copy of
    it until something changes.
    """

    def __init__(self, address: int, size: int, *, is_watched: bool = True) -> None:
        self.raw = raw_memory(address, size)
        self.stored = bytearray(self.raw)
        self.seen = bytearray(self.raw) if is_watched else self.stored

    def look(self) -> list[str]:
        """Return the names of the fields that have changed since the last look."""
        if self.seen == self.raw:
            return []
        names = self.differing(self.seen)
        self.see()
        return names

    def look_from_stored(self) -> list[str]:
        """Return the names of the fields that differ from `stored`."""
        # Compare only once, because there may be megabytes of textures.
        is_same = self.stored == self.raw
        is_one = self.seen is self.stored
        if not (is_one and is_same) and self.seen != self.raw:
            self.see()
        return [] if is_same else self.differing(self.stored)

    def see(self) -> None:
        """Remember the current bytes. `seen` changes in place; `Looks` shares it."""
        if self.seen is self.stored:
            self.seen = bytearray(self.raw)
        else:
            self.seen[:] = self.raw

    def differing(self, before: bytearray) -> list[str]:
        """Return the names of the fields that differ from a copy of the memory."""
        raise NotImplementedError


class _ArrayPiece(_Piece):
    """Arrays that follow one another in memory."""

    def __init__(self, arrays: _Arrays, *, is_watched: bool) -> None:
        first = address_of(arrays[0][1])
        super().__init__(first, _extent(arrays), is_watched=is_watched)
        self._names = [name for name, _ in arrays]
        self._starts = [address_of(array) - first for _, array in arrays]

    def differing(self, before: bytearray) -> list[str]:
        now, then = (np.frombuffer(memory, np.uint8) for memory in (self.raw, before))
        positions = np.flatnonzero(now != then)
        owners = np.searchsorted(self._starts, positions, side="right") - 1
        # Not `np.unique`, whose first call loads numpy's masked arrays (100 ms).
        return [self._names[index] for index in sorted({*owners.tolist()})]


class _StructPiece(_Piece):
    """Structs, whose members are compared one by one if any byte has changed.

    Args:
        names: the members' names, in the form that `read_fields` takes.
        holders: the other arguments of `read_fields`.
    """

    def __init__(
        self, address: int, size: int, names: Iterable[str], **holders: Any
    ) -> None:
        super().__init__(address, size)
        self._names, self._holders = [*names], holders
        self._stored_values = self._seen_values = self._values()

    def see(self) -> None:
        super().see()
        self._seen_values = self._values()

    def differing(self, before: bytearray) -> list[str]:
        is_stored = before is self.stored
        then = self._stored_values if is_stored else self._seen_values
        now = self._values()
        return [name for name in self._names if then[name] != now[name]]

    def _values(self) -> dict[str, bytes]:
        fields = read_fields(names=self._names, **self._holders)
        return {name: value.tobytes() for name, value in fields.items()}


def _pieces(model: mujoco.MjModel) -> list[tuple[bool, _Arrays]]:
    """Return the pieces of memory that hold all arrays, each with `is_watched`."""
    named = [(name, getattr(model, name)) for name in array_names()]
    arrays = [(name, array) for name, array in named if array.nbytes]
    arrays.sort(key=lambda item: address_of(item[1]))
    # If there is other memory between the arrays, each array is a piece of its own.
    are_together = _extent(arrays) <= int(model.nbuffer)
    groups = itertools.groupby(
        arrays, lambda item: (item[0].startswith(_DRAWN), are_together or item[0])
    )
    return [(is_watched, list(group)) for (is_watched, _), group in groups]


def _extent(arrays: _Arrays) -> int:
    last = arrays[-1][1]
    return address_of(last) + last.nbytes - address_of(arrays[0][1])


def _structs_of(model: mujoco.MjModel) -> _StructPiece:
    # The structs follow the sizes, and the last member of the last struct is an array.
    size = address_of(model.stat.center) + model.stat.center.nbytes - model._address
    return _StructPiece(model._address, size, struct_names(), model=model)


def _struct_of_view(name: str, struct: Any) -> _StructPiece:
    before, behind = _REACH[type(struct)]
    members = [*member_names(struct)]
    values = [(member, getattr(struct, member)) for member in members]
    arrays = [item for item in values if isinstance(item[1], np.ndarray)]
    arrays.sort(key=lambda item: address_of(item[1]))
    first, extent = address_of(arrays[0][1]), _extent(arrays)
    names = [f"{name}.{member}" for member in members]
    size = before + extent + -extent % 4 + behind
    return _StructPiece(first - before, size, names, model=None, **{name: struct})

# SPDX-License-Identifier: Apache-2.0
"""What has changed in a model and in how it is shown, found by comparing memory.

Comparing some five hundred arrays one by one takes longer than a simulation step. They
all lie in one allocation, and the structs `opt`, `vis` and `stat` one behind the other
in `mjModel` itself, so that comparing a few long pieces tells that nothing has changed,
which is usual. Only a piece that differs is looked at by name.
"""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .fields import (
    array_names,
    empty_model,
    holder_of,
    member_names,
    read_fields,
    struct_names,
)
from .raw_memory import address_of, raw_memory
from .view import SceneView

# What each frame is drawn from; whole groups, because a few long pieces are compared
# faster than what the visualiser is known to read. Other arrays are compared at resets.
_DRAWN = (
    *("geom_", "site_", "mat_", "light_", "cam_", "tendon_", "actuator_cranklength"),
    *("skin_matid", "skin_group", "skin_rgba", "skin_inflate"),
    *("flex_matid", "flex_group", "flex_rgba", "flex_radius"),
)

# How far a camera and an option reach before their first and behind their last array.
# Nothing beyond is looked at: it belongs to somebody else, and may change any time.
_REACH = {mujoco.MjvCamera: (16, 32), mujoco.MjvOption: (8, 8)}


class Looks:
    """Remembers a model and a view, and tells which of their fields have changed.

    At a reset any field of the model counts, in between what each frame is drawn from:
    not textures and meshes, which have to be uploaded to the graphics card. The model
    is only read, and kept alive.

    Args:
        model: the model, as it is stored now.

    Attributes:
        seen: what is watched, in pieces, as it was when last looked at. The list is
            another one after `follow`; its pieces are changed in place.
        present: the same pieces as they are: where the lists are equal, nothing of
            what is watched has changed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        pieces = [_struct_piece(model), *_array_pieces(model)]
        self._light = [piece for piece in pieces if piece.is_watched]
        self._heavy = [piece for piece in pieces if not piece.is_watched]
        self._view: list[_Piece] = []
        self._structs: dict[str, Any] = {}
        self.seen: list[bytearray] = []
        self.present: list[Any] = []

    def is_of(self, model: mujoco.MjModel) -> bool:
        """Tell whether `model` is the model remembered, in whatever wrapper."""
        # The address is of no other model while this one is kept alive.
        return bool(model._address == self._model._address)

    def follow(self, view: SceneView) -> None:
        """Watch the camera and the option of a view from here on, as they are now."""
        structs = {"camera": view.camera, "option": view.option}
        if all(self._structs.get(name) is struct for name, struct in structs.items()):
            for piece in self._view:
                piece.look()
            return
        self._structs = structs
        self._view = [_view_piece(*item) for item in structs.items()]
        watched = [*self._light, *self._view]
        self.seen = [piece.seen for piece in watched]
        self.present = [piece.raw for piece in watched]

    def view_bytes(self) -> bytes:
        """Return the camera and the option as bytes."""
        return b"".join(bytes(piece.raw) for piece in self._view)

    def option_bytes(self) -> bytes:
        """Return the option as bytes."""
        return bytes(self._view[1].raw)

    def since_stored(self) -> dict[str, NDArray[Any]]:
        """Return the model's fields that are other than when this was made.

        What is there now counts as seen.
        """
        pieces = [*self._light, *self._heavy]
        names = (name for piece in pieces for name in piece.look_from_stored())
        return read_fields(self._model, names)

    def changed(self, *, anything: bool = False) -> dict[str, NDArray[Any]] | None:
        """Return the watched fields that are other than when last looked at.

        Args:
            anything: look at textures, meshes and the like, too.

        Returns:
            Copies by their names; None, in a microsecond, where all are the same.
        """
        if not anything and self.seen == self.present:
            return None
        pieces = [*self._light, *self._view, *(self._heavy if anything else ())]
        names = (name for piece in pieces for name in piece.look())
        return read_fields(self._model, names, **self._structs) or None


class _Piece:
    """A piece of memory, as it was at first and as it was last seen.

    Args:
        raw: the memory.
        starts: where in it each of some fields begins, in ascending order.
        names: of the fields.
        is_watched: compared at every captured step; of others one copy is kept until
            they change.
    """

    def __init__(
        self,
        raw: Any,
        starts: Iterable[int],
        names: Iterable[str],
        *,
        is_watched: bool = True,
    ) -> None:
        self.raw = raw
        self.is_watched = is_watched
        self._bytes = np.frombuffer(memoryview(raw), np.uint8)
        self._starts, self._names = np.array(starts), list(names)
        self._stored = bytearray(raw)
        self.seen = bytearray(raw) if is_watched else self._stored

    def look(self) -> list[str]:
        """Return the names of what has changed since the last look."""
        if self.seen == self.raw:
            return []
        names = self._differing(self.seen)
        self._see(self.raw)
        return names

    def look_from_stored(self) -> list[str]:
        """Return the names of what is other than when this was made."""
        is_same = self._stored == self.raw
        if self.seen is not self._stored or not is_same:
            self._see(self.raw)
        return [] if is_same else self._differing(self._stored)

    def _see(self, present: Any) -> None:
        if self.seen is self._stored:
            self.seen = bytearray(present)
        else:
            # In place: `Looks` holds it.
            self.seen[:] = present

    def _differing(self, saved: bytearray) -> list[str]:
        positions = np.flatnonzero(self._bytes != np.frombuffer(saved, np.uint8))
        owners = np.searchsorted(self._starts, positions, side="right") - 1
        # Not `np.unique`, whose first call loads numpy's masked arrays (100 ms).
        return [self._names[index] for index in sorted({*owners.tolist()})]


def _array_pieces(model: mujoco.MjModel) -> list[_Piece]:
    """Return pieces of memory that together hold all arrays."""
    named = [(name, getattr(model, name)) for name in array_names()]
    arrays = [(name, array) for name, array in named if array.nbytes]
    arrays.sort(key=lambda item: address_of(item[1]))
    together = _lie_together(model, arrays)

    def kind(item: tuple[str, NDArray[Any]]) -> tuple[bool, str | None]:
        name, _ = item
        # Should they not lie together, each is a piece of its own.
        return name.startswith(_DRAWN), None if together else name

    pieces = []
    for (is_watched, _), group in itertools.groupby(arrays, kind):
        members = list(group)
        first = address_of(members[0][1])
        raw = raw_memory(first, _extent(members))
        starts = [address_of(array) - first for _, array in members]
        names = [name for name, _ in members]
        pieces.append(_Piece(raw, starts, names, is_watched=is_watched))
    return pieces


def _lie_together(
    model: mujoco.MjModel, arrays: list[tuple[str, NDArray[Any]]]
) -> bool:
    """Tell whether all memory between the first and the last array is the model's."""
    return _extent(arrays) <= int(model.nbuffer)


def _extent(arrays: list[tuple[str, NDArray[Any]]]) -> int:
    last = arrays[-1][1]
    return address_of(last) + last.nbytes - address_of(arrays[0][1])


def _struct_piece(model: mujoco.MjModel) -> _Piece:
    # They lie behind the sizes; the last member of the last of them is an array.
    size = address_of(model.stat.center) + model.stat.center.nbytes - model._address
    return _Piece(raw_memory(model._address, size), *_struct_places(size))


def _view_piece(name: str, struct: Any) -> _Piece:
    raw = raw_memory(*_extent_of_struct(struct))
    starts, names = _view_places(struct.__class__)
    return _Piece(raw, starts, [f"{name}.{member}" for member in names])


def _extent_of_struct(struct: Any) -> tuple[int, int]:
    before, behind = _REACH[type(struct)]
    values = [getattr(struct, name) for name in member_names(struct)]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    first = min(address_of(array) for array in arrays)
    last = max(address_of(array) + array.nbytes for array in arrays)
    return first - before, last + -last % 4 + behind - first + before


@functools.cache
def _struct_places(size: int) -> tuple[list[int], list[str]]:
    model = copy.copy(empty_model())
    return _places(model, [*struct_names()], model._address, size)


@functools.cache
def _view_places(kind: Any) -> tuple[list[int], list[str]]:
    struct = kind()
    return _places(struct, [*member_names(struct)], *_extent_of_struct(struct))


def _places(
    struct: Any, names: list[str], start: int, size: int
) -> tuple[list[int], list[str]]:
    """Return where members begin, in order, by changing them in an object of our own.

    So nothing is taken from a release's headers.
    """
    window = np.frombuffer(memoryview(raw_memory(start, size)), np.uint8)
    places = []
    for name in names:
        before = window.copy()
        holder, last = holder_of(struct, name)
        value = getattr(holder, last)
        if isinstance(value, np.ndarray):
            places.append((address_of(value) - start, name))
        else:
            # The lowest byte may be the same by chance; numbers are aligned.
            tried = -7e9 / 11 if isinstance(value, float) else value + 1
            setattr(holder, last, tried)
            changed = np.flatnonzero(before != window)
            places.append((int(changed[0]) // 4 * 4, name))
    places.sort()
    return [place for place, _ in places], [name for _, name in places]

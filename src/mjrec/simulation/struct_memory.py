# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's structs as memory: one comparison instead of a hundred attributes.

A watched struct (a model's options, a camera) is compared at every captured step.
Reading its members one by one would take longer than the capture itself; its bytes are
compared in a tenth of a microsecond. Which bytes belong to which member is found by
trying on an object of our own, not taken from a release's headers.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Values whose bytes differ from each other, and so from the member's, in each place.
_TRIED_INTEGERS = (0x01020304, 0x7A6B5C4D)
_TRIED_FLOATS = (1 / 3, -7e9 / 11)


@dataclass(frozen=True)
class Place:
    """Where a named array or member lies.

    Attributes:
        name: of the member, with dots where it is in a struct of its own.
        start: the first byte, in a `Memory` from its beginning.
        stop: one behind the last.
    """

    name: str
    start: int
    stop: int


class Memory:
    """Bytes that belong to somebody else, with names for parts of them.

    The owner must be kept alive for as long as this is used.

    Args:
        address: of the first byte.
        places: from `address` on; they do not overlap. Bytes between them are no
            part of anything and may be anything.
    """

    def __init__(self, address: int, places: list[Place]) -> None:
        size = max(place.stop for place in places)
        # Compared with a `bytearray` this is a `memcmp` without any copying.
        self.raw = (ctypes.c_ubyte * size).from_address(address)
        self._bytes = np.frombuffer(memoryview(self.raw), np.uint8)
        self._places = sorted(places, key=lambda place: place.start)
        self._starts = np.array([place.start for place in self._places])
        self._stops = np.array([place.stop for place in self._places])

    def copy(self) -> bytearray:
        """Return the bytes as they are now."""
        return bytearray(self.raw)

    def differing(self, saved: bytearray) -> list[str]:
        """Return the names of the places that are other than in an earlier copy."""
        positions = np.flatnonzero(self._bytes != np.frombuffer(saved, np.uint8))
        owners = np.searchsorted(self._starts, positions, side="right") - 1
        inside = (owners >= 0) & (positions < self._stops[owners])
        # Not `np.unique`, whose first call loads numpy's masked arrays (100 ms).
        return [
            self._places[index].name for index in sorted({*owners[inside].tolist()})
        ]


class Members:
    """Stands in for a `Memory` where the members of a struct were not found in one.

    Args:
        struct: the struct, or what it is a member of.
        names: of the members, with dots where they are in a struct of its own.
    """

    def __init__(self, struct: object, names: list[str]) -> None:
        self._struct = struct
        self._names = names
        self.raw = self

    def __eq__(self, saved: object) -> bool:
        return self.copy() == saved

    # Compared, never kept in a set.
    __hash__ = None  # type: ignore[assignment]

    def copy(self) -> bytearray:
        """Return the values as they are now, one behind the other."""
        return bytearray(b"".join(value.tobytes() for _, value in self._values()))

    def differing(self, saved: bytearray) -> list[str]:
        """Return the names of the members that are other than in an earlier copy."""
        names, offset = [], 0
        for name, value in self._values():
            if value.tobytes() != saved[offset : offset + value.nbytes]:
                names.append(name)
            offset += value.nbytes
        return names

    def _values(self) -> Iterator[tuple[str, NDArray[Any]]]:
        return ((name, read_member(self._struct, name)) for name in self._names)


def read_member(struct: object, name: str) -> NDArray[Any]:
    """Return a copy of a member of `struct`, whose name may have dots."""
    *parts, last = name.split(".")
    for part in parts:
        struct = getattr(struct, part)
    return np.array(getattr(struct, last))


def kind_of(struct: object) -> Any:
    """Return the type of a struct, as something that functions can be cached by."""
    return type(struct)


def array_address(array: NDArray[Any]) -> int:
    """Return where the first byte of an array lies."""
    return int(array.__array_interface__["data"][0])


def member_names(struct: object) -> Iterator[str]:
    """Yield the names of a struct's members that hold numbers.

    Members of structs inside it get a name with dots. An array without elements is
    none that could be read or set, and is left out.
    """
    for name in dir(struct):
        if name.startswith("_"):
            continue
        value = getattr(struct, name)
        if isinstance(value, np.ndarray):
            if value.size:
                yield name
        elif isinstance(value, int | float):
            yield name
        elif type(value).__module__.startswith("mujoco") and not callable(value):
            yield from (f"{name}.{inner}" for inner in member_names(value))


def find_places(
    struct: object, names: list[str], *, start: int, stop: int
) -> list[Place] | None:
    """Find members in memory by setting each of them and looking which bytes change.

    Args:
        struct: an object of our own, which is changed and not put back.
        names: of its members, as `member_names` gives them.
        start: the address at which to begin to look.
        stop: where to end.

    Returns:
        Places from `start` on; None where a member was not found, or found at a place
        where another one is.
    """
    window = Memory(start, [Place("", 0, stop - start)])
    places = []
    for name in names:
        place = _find(window, struct, name, start)
        if place is None or place.stop > stop - start:
            return None
        places.append(place)
    places.sort(key=lambda place: place.start)
    overlap = any(a.stop > b.start for a, b in itertools.pairwise(places))
    return None if overlap else places


def _find(window: Memory, struct: object, name: str, start: int) -> Place | None:
    holder, _, last = name.rpartition(".")
    for part in filter(None, holder.split(".")):
        struct = getattr(struct, part)
    value = getattr(struct, last)
    if isinstance(value, np.ndarray):
        offset = array_address(value) - start
        return Place(name, offset, offset + value.nbytes) if offset >= 0 else None
    return _tried(window, name, lambda tried: setattr(struct, last, tried), value)


def _tried(
    window: Memory, name: str, set_to: Callable[[Any], None], value: float
) -> Place | None:
    changed: set[int] = set()
    for tried in _TRIED_FLOATS if isinstance(value, float) else _TRIED_INTEGERS:
        before = np.frombuffer(window.copy(), np.uint8)
        set_to(tried)
        after = np.frombuffer(window.copy(), np.uint8)
        changed.update(np.flatnonzero(before != after).tolist())
    set_to(value)
    if not changed:
        return None
    # A low byte may be the same by chance; numbers are aligned to their size.
    first = min(changed) // 4 * 4
    return Place(name, first, first + (8 if max(changed) - first >= 4 else 4))

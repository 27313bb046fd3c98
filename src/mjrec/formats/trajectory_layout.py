# SPDX-License-Identifier: Apache-2.0
"""What the rows of a trajectory look like, as JSON, and checks of such JSON.

The log and the HDF5 file hold the same text. What is read may have been written by
anybody: nothing in it is used as a size before it was found to be possible.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .json_fields import field, integer, list_of, mapping, optional, text
from .trajectory import (
    FORMAT_VERSION,
    Array,
    Field,
    RowLayout,
    StateComponent,
    TrajectoryHeader,
    padded,
)

# Bytes. Far beyond any simulation's; a bound, so that no file can fill the memory.
LARGEST_ROW = 1 << 28

_DTYPES = frozenset(
    ["|b1", "|i1", "|u1", "<f2", "<f4", "<f8"]
    + [f"<{kind}{size}" for kind in "iu" for size in (2, 4, 8)]
)
_MOST_DIMENSIONS = 16
# MuJoCo has some hundred arrays.
MOST_PARTS = 4096

# They become names inside the HDF5 file, where a slash would be a path.
_NAME = re.compile(r"(?!\.{1,2}$)[^/\x00-\x1f\x7f\ud800-\udfff]{1,200}")


def check_version(version: int) -> None:
    """Raise `ValueError` for a format version that this code does not read."""
    if version > FORMAT_VERSION:
        raise ValueError(
            f"it was written by a newer mjrec, in format version {version}, and this "
            f"one reads versions up to {FORMAT_VERSION}: update mjrec"
        )
    if version < 1:
        raise ValueError(f"there is no format version {version}")


def layout_to_json(header: TrajectoryHeader) -> dict[str, Any]:
    """Return all of a header but its facts.

    Raises:
        ValueError: no file could hold such rows.
    """
    layout = {
        "state": [[c.name, c.offset, c.length] for c in header.state],
        "snapshot": [
            {"name": f.name, **array_to_json(f.array), "offset": f.offset}
            for f in header.snapshot.fields
        ],
        "action": _optional_to_json(header.action),
        "observation": _optional_to_json(header.observation),
    }
    # What is written is what a reader will accept.
    header_from_json({}, layout)
    return layout


def header_from_json(
    facts: Mapping[str, Any], layout: Mapping[str, Any]
) -> TrajectoryHeader:
    """Return the header that `layout_to_json` was given.

    Raises:
        ValueError: `layout` is of another shape, or its parts do not fit.
    """
    header = TrajectoryHeader(
        facts=facts,
        state=_check_state(field(layout, "state", list_of(_component))),
        snapshot=_check_layout(field(layout, "snapshot", list_of(_field))),
        action=field(layout, "action", optional(array_from_json)),
        observation=field(layout, "observation", optional(array_from_json)),
    )
    arrays = [array for array in (header.action, header.observation) if array]
    if 8 * header.state_length + sum(array.size for array in arrays) > LARGEST_ROW:
        raise ValueError("the row of a step would be too long")
    return header


def array_to_json(array: Array) -> dict[str, Any]:
    """Return the kind of an array."""
    return {"dtype": array.dtype, "shape": list(array.shape)}


def array_from_json(value: Any) -> Array:
    """Return the kind of an array that `array_to_json` was given.

    Raises:
        ValueError: there can be no such array.
    """
    values = mapping(value)
    dtype = field(values, "dtype", text)
    if dtype not in _DTYPES:
        raise ValueError(f"{dtype!r} is no dtype of a trajectory")
    shape = field(values, "shape", list_of(_count))
    if len(shape) > _MOST_DIMENSIONS:
        raise ValueError(f"an array would have {len(shape)} dimensions")
    # With Python's integers, which do not overflow.
    if np.dtype(dtype).itemsize * math.prod(n or 1 for n in shape) > LARGEST_ROW:
        raise ValueError(f"an array of shape {shape} would be too large")
    return Array(dtype, shape)


def field_name(value: Any) -> str:
    """Return a text that can name an array in both files."""
    name = text(value)
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name[:200]!r} cannot name an array")
    return name


def _optional_to_json(array: Array | None) -> dict[str, Any] | None:
    return None if array is None else array_to_json(array)


def _component(value: Any) -> StateComponent:
    parts: Sequence[Any] = list_of(lambda item: item)(value)
    if len(parts) != 3:
        raise ValueError("a component is its name, offset and length")
    return StateComponent(field_name(parts[0]), _count(parts[1]), _count(parts[2]))


def _field(value: Any) -> Field:
    values = mapping(value)
    return Field(
        field(values, "name", field_name),
        array_from_json(values),
        field(values, "offset", _count),
    )


def _check_state(
    components: tuple[StateComponent, ...],
) -> tuple[StateComponent, ...]:
    _check_parts([(c.name, c.offset, c.length) for c in components])
    return components


def _check_layout(fields: tuple[Field, ...]) -> RowLayout:
    _check_parts([(f.name, f.offset, padded(f.array.size)) for f in fields])
    return RowLayout(fields)


def _check_parts(parts: Sequence[tuple[str, int, int]]) -> None:
    """Check that the parts of a row have names and lie one behind the other."""
    if len(parts) > MOST_PARTS:
        raise ValueError(f"a row would have {len(parts)} parts")
    if len({name for name, _, _ in parts}) != len(parts):
        raise ValueError("two parts of a row have the same name")
    end = 0
    for name, offset, size in parts:
        if offset != end:
            raise ValueError(f"{name} is said to begin at {offset}, not at {end}")
        end += size
    if end > LARGEST_ROW:
        raise ValueError(f"a row would have a size of {end}")


def _count(value: Any) -> int:
    number = integer(value)
    if not 0 <= number <= LARGEST_ROW:
        raise ValueError(f"{number} cannot be a number of things")
    return number

# SPDX-License-Identifier: Apache-2.0
"""Changes of a model as bytes: a table of arrays in JSON, and the arrays behind it."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..json_text import loads
from .json_fields import list_of
from .trajectory import (
    Array,
    ModelChange,
    array_from_json,
    array_to_json,
    field_name,
    named_array,
)

# Its step, and the length of its table.
_PREFIX = struct.Struct("<qQ")

LARGEST_CHANGE = 1 << 30


def pack_change(change: ModelChange) -> bytes:
    """Return a change as bytes.

    Raises:
        InvalidArgument: a field is no array of plain numbers, or has no name, or all
            of them are too large.
    """
    arrays = {
        name: np.asarray(values, order="C") for name, values in change.fields.items()
    }
    table = [
        {"name": name, **array_to_json(_kind_of(name, array))}
        for name, array in arrays.items()
    ]
    text = json.dumps(table).encode()
    values = [
        array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        for array in arrays.values()
    ]
    packed = b"".join((_PREFIX.pack(change.step, len(text)), text, *values))
    if len(packed) > LARGEST_CHANGE:
        raise InvalidArgument(
            f"A change of a model may have {LARGEST_CHANGE} bytes, not {len(packed)}."
        )
    return packed


def unpack_change(packed: bytes) -> ModelChange:
    """Return the change that `pack_change` was given.

    Raises:
        ValueError: it is damaged.
    """
    if len(packed) < _PREFIX.size:
        raise ValueError("a change of the model is damaged")
    step, table_size = _PREFIX.unpack_from(packed)
    if step < 0:
        raise ValueError("a change of the model is of no step")
    offset = _PREFIX.size + table_size
    try:
        table = list_of(named_array)(loads(packed[_PREFIX.size : offset]))
    except (RecursionError, ValueError) as error:
        raise ValueError("the table of a change of the model is damaged") from error
    if offset + sum(kind.size for _, kind in table) != len(packed):
        raise ValueError("a change of the model has another size than its fields")
    if len({name for name, _ in table}) != len(table):
        raise ValueError("a change of the model has two fields of the same name")
    fields: dict[str, NDArray[Any]] = {}
    for name, kind in table:
        count = math.prod(kind.shape)
        values = np.frombuffer(packed, kind.dtype, count, offset)
        # A copy can be written to, and does not keep the rest.
        fields[name] = values.reshape(kind.shape).copy()
        offset += kind.size
    return ModelChange(step=step, fields=fields)


def _kind_of(name: str, array: NDArray[Any]) -> Array:
    kind = Array(array.dtype.newbyteorder("<").str, array.shape)
    try:
        field_name(name)
        return array_from_json(array_to_json(kind))
    except ValueError as error:
        raise InvalidArgument(
            f"The model field {name!r} cannot be recorded: {error}."
        ) from None

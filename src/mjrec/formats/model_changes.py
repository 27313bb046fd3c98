# SPDX-License-Identifier: Apache-2.0
"""Changes of a model as bytes: a step, and a NumPy record with a member for each field.

The record is as `numpy.save` writes it: its header says the names, types and shapes.
"""

from __future__ import annotations

import io
import struct

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from .trajectory import ModelChange, field_name

_STEP = struct.Struct("<q")
_LONGEST_HEADER = 1 << 16

LARGEST_CHANGE = 1 << 30


def pack_change(change: ModelChange) -> bytes:
    """Return a change as bytes.

    Raises:
        InvalidArgument: a field is no array of plain numbers, or has no name, or all
            of them are too large.
    """
    arrays = {name: np.asarray(values) for name, values in change.fields.items()}
    members = [
        (name, array.dtype.newbyteorder("<"), array.shape)
        for name, array in arrays.items()
    ]
    record = np.empty((), _checked(np.dtype(members)))
    for name, array in arrays.items():
        record[name] = array
    file = io.BytesIO()
    file.write(_STEP.pack(change.step))
    np.lib.format.write_array(file, record, (1, 0), allow_pickle=False)
    if file.tell() > LARGEST_CHANGE:
        raise InvalidArgument(
            f"A change of a model may have {LARGEST_CHANGE} bytes, not {file.tell()}."
        )
    return file.getvalue()


def unpack_change(packed: bytes) -> ModelChange:
    """Return the change that `pack_change` was given.

    Raises:
        ValueError: it is damaged.
    """
    file = io.BytesIO(packed)
    try:
        (step,) = _STEP.unpack(file.read(_STEP.size))
        np.lib.format.read_magic(file)
        shape, _, dtype = np.lib.format.read_array_header_1_0(
            file, max_header_size=_LONGEST_HEADER
        )
        _checked(dtype)
    # NumPy parses the header as Python, and raises what that raises.
    except Exception as error:
        raise ValueError(f"a change of the model is damaged ({error})") from error
    rest = file.read()
    if step < 0 or shape or len(rest) != dtype.itemsize:
        raise ValueError("a change of the model is damaged")
    record: NDArray[np.void] = np.ndarray((), dtype, rest)
    # Copies can be written to, and do not keep the rest.
    fields = {name: np.array(record[name]) for name in dtype.names or ()}
    return ModelChange(step=step, fields=fields)


def _checked(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return a record's dtype if its members are arrays of plain numbers."""
    for name in dtype.names or ():
        kind = dtype[name].base.kind
        try:
            field_name(name)
            if kind not in "biuf":
                raise ValueError(f"its dtype is {dtype[name].base}")
        except ValueError as error:
            raise InvalidArgument(
                f"The model field {name!r} cannot be recorded: {error}."
            ) from None
    return dtype

# SPDX-License-Identifier: Apache-2.0
"""Everything that is in an HDF5 file: names, attributes and datasets."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

# A name, the bytes of a text, or numbers.
Something: TypeAlias = str | bytes | NDArray[Any]

_ROWS_AT_ONCE = 1 << 14


def contents_of_hdf5(content: bytes) -> Iterator[tuple[str, Something]]:
    """Yield what is in an HDF5 file, and where: `/group/dataset@attribute`.

    Names are `str`, texts are the bytes of each, in UTF-8 if they were of Unicode, and
    all else is arrays, of a dataset some rows at a time.

    Args:
        content: the file; one that this user has made.
    """
    found: list[tuple[str, Any]] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(lambda name, item: found.append((name, item)))
        for name, item in [("", file), *found]:
            where = f"/{name}"
            yield where, name
            for key in item.attrs:
                yield where, key
                yield from _values(f"{where}@{key}", item.attrs[key])
            if isinstance(item, h5py.Dataset):
                yield from _of_dataset(where, item)


def _of_dataset(where: str, dataset: Any) -> Iterator[tuple[str, Something]]:
    for field in dataset.dtype.names or ():
        yield where, field
    if dataset.shape is None:
        return
    if dataset.shape == ():
        yield from _values(where, dataset[()])
        return
    for start in range(0, dataset.shape[0], _ROWS_AT_ONCE):
        yield from _values(where, dataset[start : start + _ROWS_AT_ONCE])


def _values(where: str, value: Any) -> Iterator[tuple[str, Something]]:
    array = np.asarray(value)
    if array.dtype.kind not in "OUS":
        yield where, array
        return
    for item in array.reshape(-1).tolist():
        is_bytes = isinstance(item, bytes)
        yield where, item if is_bytes else str(item).encode(errors="replace")

# SPDX-License-Identifier: Apache-2.0
"""The memory of a simulation, gathered and compared without a look at each array.

All arrays of `MjData` stay where they are for as long as it lives, and so do our own.
Where this process's whole memory is seen as one long array of 64-bit words, a row is
`WORDS.take(index, None, out, "clip")`: a tenth of what copying each array costs. Only
the words of an index are ever touched.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

_WORD = 8
# Beyond what any process can address; not from 0 on, which NumPy takes for no memory.
_COUNT = (1 << 56) // _WORD
WORDS: NDArray[np.uint64] = np.frombuffer(
    memoryview((ctypes.c_uint64 * _COUNT).from_address(_WORD)), np.uint64
)


def address_of(array: NDArray[Any]) -> int:
    """Return where the first byte of an array lies."""
    return int(array.__array_interface__["data"][0])


def raw_memory(address: int, size: int) -> Any:
    """Return another object's bytes; keep that alive for as long.

    Compared with a `bytearray` they are not copied: that is a `memcmp`.
    """
    return (ctypes.c_ubyte * size).from_address(address)


def words_of(arrays: Iterable[NDArray[Any]]) -> NDArray[np.intp]:
    """Return which of `WORDS` arrays are, one behind the other.

    Args:
        arrays: those for which `can_be_gathered` is true. They must be kept alive for
            as long as the words are read.
    """
    words = [np.empty(0, np.intp)]
    for array in arrays:
        if array.nbytes:
            first = address_of(array) // _WORD - 1
            words.append(np.arange(first, first - (-array.nbytes // _WORD)))
    return np.concatenate(words)


def can_be_gathered(arrays: Iterable[NDArray[Any]]) -> bool:
    """Return whether each array is contiguous and begins with a word."""
    return all(
        array.flags.c_contiguous and address_of(array) % _WORD == 0
        for array in arrays
        if array.nbytes
    )

# SPDX-License-Identifier: Apache-2.0
"""Actions and observations as arrays of one kind, step after step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.trajectory import Array

__all__ = ["StepArray", "step_array"]

# What every value of a kind fits into exactly: people give float32 to an environment
# in one step and float64 in the next.
_WIDEST = {"f": np.dtype("<f8"), "i": np.dtype("<i8"), "b": np.dtype("<i8")}


class StepArray:
    """Memory for an array that comes with every step.

    Attributes:
        kind: dtype and shape.
        bytes: of the array that was set last, `(size,) uint8`; always the same memory.
        parts: the names and shapes of a dictionary's arrays, which lie one behind the
            other; None for a plain array.
    """

    def __init__(
        self,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        parts: dict[str, tuple[int, ...]] | None = None,
    ) -> None:
        self.kind = Array(dtype.str, shape)
        self.parts = parts
        self._values: NDArray[Any] = np.zeros(shape, dtype)
        self.bytes: NDArray[np.uint8] = self._values.reshape(-1).view(np.uint8)

    @property
    def size(self) -> int:
        """The bytes of one."""
        return len(self.bytes)

    def set(self, value: Any) -> bool:
        """Take over `value`; return False, and hold zeros, where it is of another kind.

        An environment may take what a file cannot hold; recording does not stop it.
        """
        try:
            array = np.asarray(value if self.parts is None else _joined(value))
            fits = array.shape == self.kind.shape and array.dtype.kind in "fiub"
        except (AttributeError, TypeError, ValueError):
            fits = False
        np.copyto(self._values, array if fits else 0, casting="unsafe")
        return fits


def step_array(example: Any) -> StepArray | None:
    """Return memory for arrays like `example`; None where it is nothing like an array.

    Floats are kept as float64 and integers as int64, whatever their width, so that
    each value is kept exactly; a larger array of another width (a picture) keeps its
    own. A dictionary of arrays becomes one float64 vector.
    """
    if isinstance(example, Mapping):
        return _of_mapping(example)
    try:
        array = np.asarray(example)
    except ValueError:
        # Arrays of several lengths.
        return None
    if array.dtype.kind not in "fiub":
        return None
    dtype = array.dtype.newbyteorder("<")
    return StepArray(_WIDEST.get(dtype.kind, dtype), array.shape)


def _of_mapping(example: Mapping[str, Any]) -> StepArray | None:
    arrays = {str(name): np.asarray(value) for name, value in example.items()}
    if not arrays or any(array.dtype.kind not in "fiub" for array in arrays.values()):
        return None
    shapes = {name: array.shape for name, array in arrays.items()}
    return StepArray(np.dtype("<f8"), _joined(example).shape, shapes)


def _joined(value: Mapping[str, Any]) -> NDArray[np.float64]:
    arrays = [np.asarray(part, np.float64).reshape(-1) for part in value.values()]
    return np.concatenate(arrays)

# SPDX-License-Identifier: Apache-2.0
"""Buffers for actions and observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..simulation.raw_memory import words_of

_ARRAY = np.ndarray

# Dtypes that can store every value of one kind exactly. They are needed because users
# may pass float32 in one step and float64 in the next.
_WIDEST = {"f": np.dtype("<f8"), "i": np.dtype("<i8"), "b": np.dtype("<i8")}


class StepArray:
    """A buffer for an array that is recorded at every step.

    Attributes:
        kind: dtype and shape of the array, as a subarray dtype.
        values: the array that was set last. It always uses the same memory.
        words: the location of this memory (see `raw_memory.WORDS`); None if the array
            does not fill whole words.
        parts: names and shapes of the arrays in a dictionary, which are stored one
            after another; None for a plain array.
        given: the original dtype of the array that was set last; None before the first
            array, and for dictionaries.
        on_other_dtype: a function that is called when `given` has changed.
    """

    def __init__(
        self,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        parts: dict[str, tuple[int, ...]] | None = None,
    ) -> None:
        self.kind = np.dtype((dtype, shape))
        self.parts = parts
        self.values: NDArray[Any] = np.zeros(shape, dtype)
        is_whole = self.values.nbytes % 8 == 0
        self.words = words_of([self.values]) if is_whole else None
        self._shape = self.values.shape
        # Remembered because the next array usually has the same dtype.
        self.given: np.dtype[Any] | None = None
        self.on_other_dtype: Callable[[], object] = lambda: None
        # The kinds of dtypes that can be stored. Floats can store integers, but not the
        # other way around.
        self._kinds = "fiub" if dtype.kind == "f" else "iub"
        if dtype.kind == "u":
            self._kinds = "u"

    def set(self, value: Any) -> bool:
        """Copy a value into the buffer, and return whether it fits.

        If the value does not fit, the buffer is set to zero. There is no error, because
        an environment may accept values that a file cannot store.
        """
        # This is the usual case.
        if (
            type(value) is _ARRAY
            and value.dtype is self.given
            and value.shape == self._shape
        ):
            self.values[...] = value
            return True
        return self._set_other(value)

    def _set_other(self, value: Any) -> bool:
        try:
            array = np.asarray(value if self.parts is None else self._joined(value))
            fits = array.shape == self.kind.shape and array.dtype.kind in self._kinds
        except (AttributeError, KeyError, TypeError, ValueError):
            fits = False
        self.values[...] = array if fits else 0
        if fits and self.parts is None and array.dtype is not self.given:
            self.given = array.dtype
            self.on_other_dtype()
        return fits

    def _joined(self, value: Mapping[str, Any]) -> NDArray[np.float64]:
        assert self.parts is not None
        if value.keys() != self.parts.keys():
            raise KeyError(*value.keys() ^ self.parts.keys())
        arrays = [np.asarray(value[name], np.float64) for name in self.parts]
        if [array.shape for array in arrays] != list(self.parts.values()):
            raise ValueError("an array has a different shape than before")
        return np.concatenate([array.reshape(-1) for array in arrays])


def step_array(example: Any) -> StepArray | None:
    """Return a buffer for arrays like `example`, or None if it is not an array.

    Floats are stored as float64. Signed integers and bools are stored as int64. Every
    value is therefore stored exactly. Unsigned integers (such as frames) keep their
    dtype. A dictionary of arrays becomes a single float64 vector.
    """
    if isinstance(example, Mapping):
        return _of_mapping(example)
    try:
        array = np.asarray(example)
    except ValueError:
        # The example is a ragged sequence.
        return None
    if array.dtype.kind not in "fiub":
        return None
    dtype = array.dtype.newbyteorder("<")
    return StepArray(_WIDEST.get(dtype.kind, dtype), array.shape)


def action_array(example: Any) -> StepArray | None:
    """Return a buffer for actions like `example`, or None if it is not an array.

    The buffer is like that from `step_array`, except that arrays of signed integers
    become float64. This is because `[0.5, 0.1]` may follow `[0, 0]`. A single integer
    is a discrete action and remains an integer.
    """
    if isinstance(example, list | tuple | np.ndarray):
        array = step_array(example)
        if array is not None and array.kind.base == "<i8" and array.kind.shape:
            return StepArray(np.dtype("<f8"), array.kind.shape)
        return array
    return step_array(example)


def _of_mapping(example: Mapping[str, Any]) -> StepArray | None:
    arrays = {name: np.asarray(value) for name, value in example.items()}
    names_are_text = all(isinstance(name, str) for name in arrays)
    if not arrays or not names_are_text:
        return None
    if any(array.dtype.kind not in "fiub" for array in arrays.values()):
        return None
    shapes = {name: array.shape for name, array in arrays.items()}
    size = sum(array.size for array in arrays.values())
    return StepArray(np.dtype("<f8"), (size,), shapes)

# SPDX-License-Identifier: Apache-2.0
"""Actions and observations as arrays of one kind, and the rows that hold them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_ARRAY = np.ndarray

# What every value of a kind fits into exactly: people give float32 to an environment
# in one step and float64 in the next.
_WIDEST = {"f": np.dtype("<f8"), "i": np.dtype("<i8"), "b": np.dtype("<i8")}


class StepArray:
    """Memory for an array that comes with every step.

    Attributes:
        kind: dtype and shape, as a dtype.
        values: the array that was set last; always the same memory.
        parts: the names and shapes of a dictionary's arrays, which lie one behind the
            other; None for a plain array.
        given: the dtype of the array that was set last, as it came; None before the
            first one, and for dictionaries.
        on_other_dtype: called when `given` has changed.
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
        self._shape = self.values.shape
        # The next one's is usually the same.
        self.given: np.dtype[Any] | None = None
        self.on_other_dtype: Callable[[], object] = lambda: None
        # What goes in without a loss: integers into floats, and not the other way.
        self._kinds = "fiub" if dtype.kind == "f" else "iub"
        if dtype.kind == "u":
            self._kinds = "u"

    @property
    def size(self) -> int:
        """The bytes of one."""
        return self.values.nbytes

    def set(self, value: Any) -> bool:
        """Take over `value`; return False, and hold zeros, where it is of another kind.

        An environment may take what a file cannot hold; recording does not stop it.
        """
        # The usual case, at every step.
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
            raise ValueError("an array has another shape than before")
        return np.concatenate([array.reshape(-1) for array in arrays])


def step_array(example: Any) -> StepArray | None:
    """Return memory for arrays like `example`; None where it is nothing like an array.

    Floats are kept as float64 and integers as int64, whatever their width, so that
    each value is kept exactly; a larger array of another width (a frame) keeps its
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


def action_array(example: Any) -> StepArray | None:
    """Return memory for actions like `example`; None where it is nothing like an array.

    As `step_array`, but for arrays of integers, which become float64: who begins
    with `[0, 0]` may go on with `[0.5, 0.1]`. A single integer is a choice and stays.
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


class RowLayout(NamedTuple):
    """What rows consist of. The next recording's are usually the same.

    Attributes:
        state, snapshot: what is taken of the simulation.
        action: memory for actions.
        observation: dtype and shape of an observation.
        start_words: where state and snapshot lie in memory, if they can be gathered.
        dtype: of a row.
        words: where all of a row but its head lies, if it can be gathered.
    """

    state: np.dtype[Any] | None
    snapshot: np.dtype[Any] | None
    action: StepArray | None
    observation: np.dtype[Any] | None
    start_words: NDArray[np.intp] | None
    dtype: np.dtype[Any]
    words: NDArray[np.intp] | None

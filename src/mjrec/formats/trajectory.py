# SPDX-License-Identifier: Apache-2.0
"""What a trajectory holds, whichever of its two forms it has.

A recorded episode is first a span of the monitor's row log (`spans`), and then an HDF5
file (`trajectory_hdf5`). Both hold facts, rows and changes of the model; the JSON that
describes their rows is the same. `docs/format.md` is the specification of both.
"""

from __future__ import annotations

import abc
import functools
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidArgument
from .json_fields import field, integer, list_of, mapping, optional, text

FORMAT_VERSION = 1

# What is in a file is read as such and as nothing else: no objects, no texts.
_DTYPES = frozenset(
    ["|b1", "|i1", "|u1", "<f2", "<f4", "<f8"]
    + [f"<{kind}{size}" for kind in "iu" for size in (2, 4, 8)]
)

# They become names inside the HDF5 file, where a slash would be a path.
_NAME = re.compile(r"(?!\.{1,2}$)[^/\x00-\x1f\x7f\ud800-\udfff]{1,200}")


def padded(size: int) -> int:
    """Return a number of bytes, made a multiple of 8."""
    return -(-size // 8) * 8


@dataclass(frozen=True)
class Array:
    """The kind of an array that is there once for every step.

    Attributes:
        dtype: as `numpy.dtype.str` has it, little-endian: `<f8`, `<i4`, `|u1`.
        shape: of one step's array.
    """

    dtype: str
    shape: tuple[int, ...]

    @functools.cached_property
    def numpy(self) -> np.dtype[Any]:
        """The type of one, a subarray."""
        return np.dtype((self.dtype, self.shape))

    @property
    def size(self) -> int:
        """The bytes of one."""
        return self.numpy.itemsize


@dataclass(frozen=True)
class Field:
    """A named array inside a packed row.

    Attributes:
        name: MuJoCo's name of the array.
        array: its kind.
        offset: in bytes from the row's beginning.
    """

    name: str
    array: Array
    offset: int


@dataclass(frozen=True)
class RowLayout:
    """Where the arrays are inside a row of bytes, one behind the other.

    Each begins at a multiple of 8 bytes, as in MuJoCo's own memory.
    """

    fields: tuple[Field, ...] = ()

    @classmethod
    def packed(cls, arrays: Iterable[tuple[str, Array]]) -> RowLayout:
        """Return the layout of arrays, given with their names."""
        fields: list[Field] = []
        offset = 0
        for name, array in arrays:
            fields.append(Field(name, array, offset))
            offset += padded(array.size)
        return cls(tuple(fields))

    @functools.cached_property
    def size(self) -> int:
        """The bytes of a row."""
        return sum(padded(field.array.size) for field in self.fields)

    @functools.cached_property
    def padding(self) -> NDArray[np.intp]:
        """Where in a row there is nothing."""
        free = np.ones(self.size, bool)
        for part in self.fields:
            free[part.offset : part.offset + part.array.size] = False
        return np.flatnonzero(free)

    def unpack(self, rows: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Return copies of the arrays in `rows` by their names.

        Args:
            rows: `(size,)` or `(n, size) uint8`.

        Returns:
            `(*shape,)` or `(n, *shape)` each, little-endian.
        """
        return {field.name: _unpacked(field, rows) for field in self.fields}


@dataclass(frozen=True)
class StateComponent:
    """A part of a physics state, by name because MuJoCo's bit numbers move.

    Attributes:
        name: MuJoCo's, in lower case: `time`, `qpos`, `qvel`, `warmstart`, `ctrl` ...
        offset: in numbers from the beginning of the state.
        length: in numbers.
    """

    name: str
    offset: int
    length: int


@dataclass(frozen=True, kw_only=True)
class TrajectoryHeader:
    """What is known of an episode besides its rows.

    Attributes:
        facts: what JSON can hold; `docs/format.md` lists the keys. What becomes known
            while the episode runs (its rate, its end) is among them as far as it is.
        state: the components of a row of `states`; none where there is no simulation.
        snapshot: of a row of `snapshots`.
        action: of an action; None where actions are no plain arrays.
        observation: of an observation; None where they are not recorded.
    """

    facts: Mapping[str, Any]
    state: tuple[StateComponent, ...] = ()
    snapshot: RowLayout = RowLayout()
    action: Array | None = None
    observation: Array | None = None

    @property
    def state_length(self) -> int:
        """The numbers in a state."""
        return sum(component.length for component in self.state)


@dataclass(frozen=True, kw_only=True)
class ModelChange:
    """Model fields that are other than before, from some step on.

    Attributes:
        step: the first step that they hold for; 0 is what differs from the stored
            model since the reset.
        fields: their new values: arrays of `MjModel` by their names (`geom_rgba`),
            members of its structs as `opt.gravity`, `vis.headlight.ambient`,
            `stat.extent`; and, of the view, `camera.lookat`, `option.flags` ...
    """

    step: int
    fields: Mapping[str, NDArray[Any]]


def _unpacked(field: Field, rows: NDArray[np.uint8]) -> NDArray[Any]:
    part = rows[..., field.offset : field.offset + field.array.size]
    values = np.ascontiguousarray(part).view(field.array.dtype)
    return values.reshape(rows.shape[:-1] + field.array.shape)


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
        "state": [[c.name, c.length] for c in header.state],
        "snapshot": [
            {"name": f.name, **array_to_json(f.array)} for f in header.snapshot.fields
        ],
        "action": header.action and array_to_json(header.action),
        "observation": header.observation and array_to_json(header.observation),
    }
    # What is written is what a reader will make of it.
    if header_from_json(header.facts, layout) != header:
        raise ValueError("the parts of its rows do not lie one behind the other")
    return layout


def header_from_json(
    facts: Mapping[str, Any], layout: Mapping[str, Any]
) -> TrajectoryHeader:
    """Return the header that `layout_to_json` was given.

    Raises:
        ValueError: `layout` is of another shape, or there can be no such rows.
    """
    state = field(layout, "state", list_of(_component))
    offsets = itertools.accumulate((length for _, length in state), initial=0)
    snapshot = field(layout, "snapshot", list_of(named_array))
    for parts in (state, snapshot):
        if len(dict(parts)) != len(parts):
            raise ValueError("two parts of a row have the same name")
    return TrajectoryHeader(
        facts=facts,
        state=tuple(
            StateComponent(name, offset, length)
            for (name, length), offset in zip(state, offsets, strict=False)
        ),
        snapshot=RowLayout.packed(snapshot),
        action=field(layout, "action", optional(array_from_json)),
        observation=field(layout, "observation", optional(array_from_json)),
    )


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
        raise ValueError(f"{dtype!r:.80} is no dtype of a trajectory")
    shape = field(values, "shape", list_of(_count))
    # NumPy refuses what no array can be.
    np.dtype((dtype, shape))
    return Array(dtype, shape)


def field_name(value: Any) -> str:
    """Return a text that can name an array in both files."""
    name = text(value)
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name[:200]!r} cannot name an array")
    return name


def named_array(value: Any) -> tuple[str, Array]:
    """Return the name and the kind of an array that has both."""
    values = mapping(value)
    return field(values, "name", field_name), array_from_json(values)


def _component(value: Any) -> tuple[str, int]:
    parts = list_of(lambda item: item)(value)
    if len(parts) != 2:
        raise ValueError("a component is its name and its length")
    return field_name(parts[0]), _count(parts[1])


def _count(value: Any) -> int:
    number = integer(value)
    if number < 0:
        raise ValueError(f"{number} cannot be a number of things")
    return number


def added_up(rewards: ArrayLike) -> float:
    """Return the sum of rewards, one added after the other, as a monitor does.

    `sum` makes up for roundings from Python 3.12 on, and NumPy's adds in pairs.
    """
    values = np.asarray(rewards, np.float64)
    # Zero comes first: it makes the sum of negative zeros a positive one.
    with np.errstate(all="ignore"):
        return 0.0 + float(np.add.accumulate(values)[-1]) if len(values) else 0.0


class TrajectoryReader(abc.ABC):
    """An open trajectory. T is the number of steps, F of video frames.

    Only what describes the rows is in memory; rows are read when they are asked for,
    in ranges `start, stop` as Python counts them. A reader is used by one thread, and
    in the process that opened it.

    Attributes:
        path: of the file.
        header: what is known of the episode besides its rows.
        row_count: how many states there are: T + 1, the first after the reset; 0 in
            the log of an episode that was killed before that was written.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`.
        truncated: `(T,) bool`.
        frame_steps: `(F,) int64`, the step that each snapshot was taken after.
        change_count: how often the model changed.
        dropped: how many rows and other records at the end of the log were torn or
            damaged, as far as they can be counted, and are not here.
    """

    path: Path
    header: TrajectoryHeader
    row_count: int
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    frame_steps: NDArray[np.int64]
    change_count: int
    dropped: int

    @property
    def step_count(self) -> int:
        """T."""
        return len(self.rewards)

    @property
    def frame_count(self) -> int:
        """F."""
        return len(self.frame_steps)

    def states(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return `(stop - start, state_length) float64`, of `row_count` rows.

        Raises:
            UnreadableFile: the file was damaged since it was opened.
        """
        return self._range("states", start, stop, self.row_count)

    def actions(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of T; None where they are not recorded."""
        if self.header.action is None:
            return None
        return self._range("actions", start, stop, self.step_count)

    def observations(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of `row_count`; None as of `actions`."""
        if self.header.observation is None:
            return None
        return self._range("observations", start, stop, self.row_count)

    def snapshots(self, start: int, stop: int) -> NDArray[np.uint8]:
        """Return `(stop - start, snapshot.size) uint8` packed rows, of F."""
        return self._range("snapshots", start, stop, self.frame_count)

    def iter_model_changes(self) -> Iterator[ModelChange]:
        """Yield the changes of the model in the order of their steps."""
        return (self._model_change(index) for index in range(self.change_count))

    @functools.cached_property
    def model_changes(self) -> tuple[ModelChange, ...]:
        """The changes of the model in the order of their steps; read once."""
        return tuple(self.iter_model_changes())

    @abc.abstractmethod
    def close(self) -> None:
        """Close the file; idempotent. What is in memory stays."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} {str(self.path)!r} {self.step_count} steps, "
            f"{self.frame_count} frames>"
        )

    def _range(self, name: str, start: int, stop: int, count: int) -> NDArray[Any]:
        if not 0 <= start <= stop <= count:
            raise InvalidArgument(
                f"{self.path.name} has {count} {name}; there are none from {start} to "
                f"{stop}."
            )
        return self._rows(name, start, stop)

    @abc.abstractmethod
    def _rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return some of the states, actions, observations or snapshots."""

    @abc.abstractmethod
    def _model_change(self, index: int) -> ModelChange: ...

# SPDX-License-Identifier: Apache-2.0
"""What a trajectory holds, whichever of its two files it is in.

A recorded episode is first a span of the monitor's row log (`spans`), and then an HDF5
file (`trajectory_hdf5`). Both hold the same: facts, rows and model changes.
`docs/format.md` is the specification of both.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT_VERSION = 1


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
    def size(self) -> int:
        """The bytes of one."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.shape, dtype=int))


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
        for field in self.fields:
            free[field.offset : field.offset + field.array.size] = False
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


@dataclass(frozen=True, kw_only=True)
class TrajectoryContent:
    """All of a trajectory, as arrays. T is the number of steps, F of video frames.

    Attributes:
        header: what is known besides.
        states: `(T + 1, state_length) float64`, the first after the reset; none at all
            in the log of an episode that was killed before that was written.
        actions: `(T, *shape)`, or None.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`.
        truncated: `(T,) bool`.
        observations: `(T + 1, *shape)`, or None.
        frame_steps: `(F,) int64`, the step that each snapshot was taken after.
        snapshots: `(F, snapshot.size) uint8`, packed rows.
        model_changes: in the order of their steps.
        dropped: how many rows and other records at the end of the log were torn or
            damaged, as far as they can be counted, and are not here.
    """

    header: TrajectoryHeader
    states: NDArray[np.float64]
    actions: NDArray[Any] | None
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    observations: NDArray[Any] | None
    frame_steps: NDArray[np.int64]
    snapshots: NDArray[np.uint8]
    model_changes: tuple[ModelChange, ...] = ()
    dropped: int = 0


def _unpacked(field: Field, rows: NDArray[np.uint8]) -> NDArray[Any]:
    part = rows[..., field.offset : field.offset + field.array.size]
    values = np.ascontiguousarray(part).view(field.array.dtype)
    return values.reshape(rows.shape[:-1] + field.array.shape)

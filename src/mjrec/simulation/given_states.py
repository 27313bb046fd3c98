# SPDX-License-Identifier: Apache-2.0
"""Physics states that somebody simulated, to be drawn in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FileNotWritten, InvalidArgument
from .authored_model import with_embedded_files
from .cameras import raw_model

_MODEL, _STATES = "model.mjb", "states.npy"


def check_states(model: Any, states: ArrayLike, spec: int) -> NDArray[np.float64]:
    """Return `states` as `(n, size) float64`.

    Args:
        model: a `mujoco.MjModel`, or dm_control's wrapper of one.
        states: one row for each state.
        spec: which components a row has, a combination of `mujoco.mjtState`.

    Raises:
        InvalidArgument: `spec` is no combination of states, or the shape is another.
    """
    size = _state_size(raw_model(model), spec)
    rows = np.asarray(states)
    if rows.dtype.kind not in "iuf":
        raise InvalidArgument(f"States are numbers, got an array of {rows.dtype}.")
    if rows.ndim == 3 and rows.shape[2] == size:
        raise InvalidArgument(
            f"States are wanted as (n, {size}), got {rows.shape}: the shape that "
            "mujoco.rollout gives, many runs of many steps. Give one run, states[k], "
            f"or states.reshape(-1, {size}) for all, one after the other."
        )
    if rows.ndim != 2 or rows.shape[1] != size:
        raise InvalidArgument(
            f"States are wanted as (n, {size}), because mujoco.mj_stateSize(model, "
            f"{int(spec)}) is {size}, got {rows.shape}. Give the spec that the rows "
            "were made with, and the model that they belong to."
        )
    return np.ascontiguousarray(rows, np.float64)


def save_states(directory: Path, model: Any, states: NDArray[np.float64]) -> None:
    """Write what `GivenStates` reads.

    Raises:
        FileNotWritten: the disk is full.
    """
    try:
        mujoco.mj_saveModel(
            with_embedded_files(raw_model(model)), str(directory / _MODEL), None
        )
        np.save(directory / _STATES, states, allow_pickle=False)
    except (OSError, mujoco.FatalError) as error:
        raise FileNotWritten(directory, error) from error


class GivenStates:
    """A model and its data in one of the states that `save_states` has written.

    Everything that follows from a state is computed, as `mj_forward` does; what the
    rows leave out is as in a new `MjData`. So each picture depends on its row alone.

    Args:
        directory: where `save_states` wrote.
        spec: which components a row has.

    Attributes:
        model: the model.
        data: its data, in the state last brought to.
    """

    def __init__(self, directory: Path, spec: int) -> None:
        self.model = mujoco.MjModel.from_binary_path(str(directory / _MODEL))
        self.data = mujoco.MjData(self.model)
        self._spec = spec
        # Only the rows that are asked for come into memory.
        self._states = np.load(directory / _STATES, mmap_mode="r", allow_pickle=False)

    @property
    def count(self) -> int:
        """How many rows there are."""
        return len(self._states)

    def bring_to(self, index: int) -> bool:
        """Put a row into the data; return False: the model never changes."""
        mujoco.mj_resetData(self.model, self.data)
        # A copy: mujoco 3.3 takes none that it could not write to.
        state = np.array(self._states[index])
        mujoco.mj_setState(self.model, self.data, state, self._spec)
        mujoco.mj_forward(self.model, self.data)
        return False


def _state_size(model: mujoco.MjModel, spec: Any) -> int:
    try:
        return int(mujoco.mj_stateSize(model, int(spec)))
    except (TypeError, ValueError, mujoco.FatalError) as error:
        raise InvalidArgument(
            f"spec must be a combination of mujoco.mjtState, got {spec!r}: {error}."
        ) from error

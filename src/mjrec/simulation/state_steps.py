# SPDX-License-Identifier: Apache-2.0
"""Steps made again from recorded states.

The state after `n` physics steps depends on nothing but the state before and the
inputs, and the inputs of a control step stand in the state that was recorded after it:
MuJoCo leaves them alone. So a recorded row follows from the row before it and from its
own inputs.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import StateComponent
from .integration_state import STATE_SPEC, state_components
from .model_fields import apply_fields

# What a simulation with these keeps outside its state, so that no step follows from it.
_BEYOND_STATE = ("mjENBL_SLEEP", "mjENBL_IPC")


class StateSteps:
    """Makes the steps of a model again, each from its own recorded state.

    Args:
        model: it is copied.
        components: of the recorded rows.

    Raises:
        InvalidArgument: the rows are not states of this model.
    """

    def __init__(
        self, model: mujoco.MjModel, components: Sequence[StateComponent]
    ) -> None:
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._columns = _columns(self._model, components)
        self._inputs = _input_columns(self._model)

    @property
    def timestep(self) -> float:
        """Seconds of one physics step."""
        return float(self._model.opt.timestep)

    @property
    def keeps_more_than_state(self) -> bool:
        """Whether the model has options with which steps do not follow from states."""
        flags = mujoco.mjtEnableBit.__members__
        return any(
            name in flags and self._model.opt.enableflags & int(flags[name])
            for name in _BEYOND_STATE
        )

    def change(self, fields: Mapping[str, NDArray[Any]]) -> None:
        """Change the model for the steps to come.

        Raises:
            InvalidArgument: it has no such fields.
        """
        apply_fields(self._model, fields)

    def follow(
        self, rows: NDArray[np.float64], substeps: Iterable[int]
    ) -> NDArray[np.float64]:
        """Return what each state becomes with the inputs that stand in the next.

        Args:
            rows: recorded states, `(n + 1, state_length)`.
            substeps: the physics steps from each to the next, `n` of them.

        Returns:
            `(n, state_length)`, in the order of the recorded components: what rows 1
            to `n` should be.
        """
        own = rows[:, self._columns]
        starts = own[:-1].copy()
        starts[:, self._inputs] = own[1:, self._inputs]
        found = np.empty_like(starts)
        model, data = self._model, self._data
        for start, number, out in zip(starts, substeps, found, strict=True):
            mujoco.mj_setState(model, data, start, STATE_SPEC)
            mujoco.mj_step(model, data, nstep=number)
            mujoco.mj_getState(model, data, out, STATE_SPEC)
        result = np.empty_like(found)
        result[:, self._columns] = found
        return result


class LiveStates:
    """The states of a simulation that an environment drives, as rows of a recording.

    Args:
        model: the environment's.
        data: its.
        components: of the recorded rows.
        is_settled: whether the environment leaves positions and velocities computed
            for its state after each step, as dm_control does, and not for the substep
            before, as `mj_step` alone does.

    Raises:
        InvalidArgument: the rows are not states of this model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        components: Sequence[StateComponent],
        *,
        is_settled: bool,
    ) -> None:
        self._model = model
        self._data = data
        self._columns = _columns(model, components)
        self._is_settled = is_settled
        self._own = np.empty(len(self._columns))
        order = np.arange(len(self._columns))
        self._is_own_order = np.array_equal(self._columns, order)

    def read(self, out: NDArray[np.float64]) -> None:
        """Write the state of this moment into a row."""
        if self._is_own_order:
            mujoco.mj_getState(self._model, self._data, out, STATE_SPEC)
            return
        mujoco.mj_getState(self._model, self._data, self._own, STATE_SPEC)
        out[self._columns] = self._own

    def bring_to(self, row: NDArray[np.float64]) -> None:
        """Put the simulation into a recorded state, near which it is already.

        What the environment's last step left behind besides the state stays: bodies
        where they were one substep before.
        """
        own = np.ascontiguousarray(row[self._columns])
        mujoco.mj_setState(self._model, self._data, own, STATE_SPEC)
        if self._is_settled:
            mujoco.mj_step1(self._model, self._data)

    def begin_at(self, row: NDArray[np.float64]) -> None:
        """Put the simulation into a recorded state just after a reset, as resets do.

        All that follows from that state is computed, as it is after a reset.
        """
        own = np.ascontiguousarray(row[self._columns])
        mujoco.mj_setState(self._model, self._data, own, STATE_SPEC)
        if self._is_settled:
            mujoco.mj_step1(self._model, self._data)
        else:
            mujoco.mj_forward(self._model, self._data)
            # The solver's warm start is another one now.
            mujoco.mj_setState(self._model, self._data, own, STATE_SPEC)


def _columns(
    model: mujoco.MjModel, components: Sequence[StateComponent]
) -> NDArray[np.intp]:
    """Return where in a recorded row the numbers of this MuJoCo's state stand."""
    recorded = {part.name: part for part in components}
    own = state_components(model)
    given = {name: part.length for name, part in recorded.items()}
    width = sum(given.values())
    is_inside = all(0 <= p.offset <= width - p.length for p in components)
    if given != {part.name: part.length for part in own} or not is_inside:
        raise InvalidArgument(
            "the recorded states are not states of this model: they hold "
            f"{_listed(components)}, and its own {_listed(own)}"
        )
    ranges = [
        np.arange(recorded[part.name].offset, recorded[part.name].offset + part.length)
        for part in own
    ]
    return np.concatenate(ranges)


def _listed(components: Iterable[StateComponent]) -> str:
    return ", ".join(f"{part.name} ({part.length})" for part in components)


def _input_columns(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which numbers of a state are inputs, in this MuJoCo's order."""
    states = mujoco.mjtState.__members__
    user = int(states["mjSTATE_USER"])
    parts = [
        np.full(p.length, bool(int(states[f"mjSTATE_{p.name.upper()}"]) & user))
        for p in state_components(model)
    ]
    return np.concatenate(parts)

# SPDX-License-Identifier: Apache-2.0
"""Snapshots made again from recorded states.

What pictures are drawn from follows from states in one of two ways. After `mj_step`
bodies are where they were at the state before its last substep: so Gymnasium's
environments are drawn. dm_control's compute them anew for the state that they are in,
as all do in a reset.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import RowLayout, StateComponent
from .integration_state import STATE_SPEC, set_state, state_components
from .model_fields import apply_fields
from .snapshot import SnapshotSource, drawn_readings, layout_objection


class SnapshotSteps:
    """Takes snapshots of a model again, each from recorded states alone.

    Args:
        model: it is copied.
        components: of the recorded states.
        layout: of the recorded snapshots.

    Raises:
        InvalidArgument: states or snapshots are not of this model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        components: Sequence[StateComponent],
        layout: RowLayout,
    ) -> None:
        objection = layout_objection(model, layout)
        if objection is not None:
            raise InvalidArgument(objection)
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._components = components
        self._inputs = _input_columns(self._model, components)
        self._layout = layout
        self._source = SnapshotSource(self._model, self._data, layout)
        columns = _columns(layout)
        self._unseen = np.zeros(sum(map(len, columns.values())), bool)
        if "sensordata" in columns:
            self._unseen[columns["sensordata"]] = ~drawn_readings(self._model)
        self._paths = [columns[n] for n in ("wrap_obj", "wrap_xpos") if n in columns]

    @property
    def timestep(self) -> float:
        """Seconds of one physics step."""
        return float(self._model.opt.timestep)

    def change(self, fields: Mapping[str, NDArray[Any]]) -> None:
        """Change the model for the snapshots to come; what is of the view is left out.

        Raises:
            InvalidArgument: it has no such fields.
        """
        apply_fields(self._model, fields)

    def settled(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the numbers of a snapshot that is computed for a state."""
        set_state(self._model, self._data, self._components, state)
        mujoco.mj_step1(self._model, self._data)
        return self._numbers()

    def stepped(
        self,
        before: NDArray[np.float64],
        after: NDArray[np.float64],
        substeps: int,
    ) -> NDArray[np.float64]:
        """Return the numbers of a snapshot as `mj_step` leaves it.

        Args:
            before: the state that the steps begin at.
            after: the state that holds their inputs.
            substeps: the physics steps.
        """
        start = np.where(self._inputs, after, before)
        set_state(self._model, self._data, self._components, start)
        mujoco.mj_step(self._model, self._data, nstep=substeps)
        return self._numbers()

    def alike(
        self, recorded: NDArray[np.float64], found: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return what is recorded, but what is found where no picture depends on it.

        Points behind the last of all tendons' paths are left over from earlier paths,
        and of sensors only those that are drawn matter.

        Args:
            recorded: the numbers of a recorded snapshot.
            found: those of the one that was taken last.
        """
        unseen = self._unseen.copy()
        if self._paths:
            used = _used_points(self._model, self._data)
            for columns in self._paths:
                unseen[columns.reshape(len(used), -1)[~used]] = True
        return np.where(unseen, found, recorded)

    def _numbers(self) -> NDArray[np.float64]:
        row = np.empty(self._layout.size, np.uint8)
        self._source.take(row)
        return _numbers_of_one(self._layout, row)


def live_snapshot(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    components: Sequence[StateComponent],
    layout: RowLayout,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return state and snapshot of a simulation, as it is, as recordings hold them.

    Raises:
        InvalidArgument: what is recorded is not of this model.
    """
    objection = layout_objection(model, layout)
    own = {part.name: part for part in state_components(model)}
    if objection is None and own.keys() != {part.name for part in components}:
        objection = "The recorded states are not states of this model."
    if objection is not None:
        raise InvalidArgument(objection)
    whole = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, whole, STATE_SPEC)
    parts = [
        whole[own[part.name].offset :][: own[part.name].length]
        for part in sorted(components, key=lambda part: part.offset)
    ]
    row = np.empty(layout.size, np.uint8)
    SnapshotSource(model, data, layout).take(row)
    return np.concatenate(parts), _numbers_of_one(layout, row)


def numbers_of(layout: RowLayout, rows: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return packed snapshots, `(n, size)`, as numbers, one behind the other."""
    arrays = layout.unpack(rows).values()
    return np.concatenate(
        [array.reshape(len(rows), -1).astype(np.float64) for array in arrays], axis=1
    )


def _numbers_of_one(layout: RowLayout, row: NDArray[np.uint8]) -> NDArray[np.float64]:
    return numbers_of(layout, row[np.newaxis]).reshape(-1)


def column_names(layout: RowLayout) -> list[str]:
    """Return what each of the numbers is called: `geom_xpos[3, 2]`."""
    return [
        f"{field.name}{list(index)}"
        for field in layout.fields
        for index in np.ndindex(field.array.shape)
    ]


def _columns(layout: RowLayout) -> dict[str, NDArray[np.intp]]:
    """Return where the numbers of each field stand."""
    columns: dict[str, NDArray[np.intp]] = {}
    start = 0
    for field in layout.fields:
        count = int(np.prod(field.array.shape, dtype=int))
        columns[field.name] = np.arange(start, start + count)
        start += count
    return columns


def _used_points(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.bool_]:
    """Return which of the points that tendons may run over they do run over."""
    used = np.zeros(2 * model.nwrap, bool)
    for first, count in zip(data.ten_wrapadr, data.ten_wrapnum, strict=True):
        used[first : first + count] = True
    return used


def _input_columns(
    model: mujoco.MjModel, components: Sequence[StateComponent]
) -> NDArray[np.bool_]:
    """Return which numbers of a recorded state are inputs.

    Raises:
        InvalidArgument: it is no state of this model.
    """
    states = mujoco.mjtState.__members__
    own = {part.name: part.length for part in state_components(model)}
    if {part.name: part.length for part in components} != own:
        raise InvalidArgument("The recorded states are not states of this model.")
    inputs = np.zeros(sum(own.values()), bool)
    for part in components:
        is_input = int(states[f"mjSTATE_{part.name.upper()}"]) & int(
            states["mjSTATE_USER"]
        )
        inputs[part.offset : part.offset + part.length] = bool(is_input)
    return inputs

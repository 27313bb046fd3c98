# SPDX-License-Identifier: Apache-2.0
"""Steps and snapshots made again from recorded states.

The state after `n` physics steps depends on nothing but the state before and the
inputs, and the inputs of a control step stand in the state that was recorded after it:
MuJoCo leaves them alone. So a recorded row follows from the row before it and from its
own inputs.

Snapshots follow from states in one of two ways. After `mj_step` bodies are where they
were at the state before its last substep: so Gymnasium's environments are drawn.
dm_control's compute them anew for the state that they are in, as all do in a reset.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..formats.trajectory import columns_of
from .captured_arrays import drawn_readings
from .fields import apply_fields
from .snapshot import SnapshotSource, check_layout
from .states import STATE_BITS, STATE_SPEC, read_state, state_columns, state_dtype

# What a simulation with these keeps outside its state, so that no step follows from it.
_BEYOND_STATE = ("mjENBL_SLEEP", "mjENBL_IPC")

# Geoms whose contacts move smoothly; others' are found by iterating, or choose among
# corners.
_SMOOTH = ("PLANE", "SPHERE", "CAPSULE")


class StateSteps:
    """Makes the steps of a model again, each from its own recorded state.

    Args:
        model: it is copied.
        parts: of the recorded rows, as `TrajectoryReader.columns` has them.

    Raises:
        InvalidArgument: the rows are not states of this model.
    """

    def __init__(self, model: mujoco.MjModel, parts: Mapping[str, slice]) -> None:
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._columns = state_columns(self._model, parts)
        self._inputs = _input_numbers(self._model)

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
        """Change the model for the steps to come; what is of the view is left out.

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
        found = np.empty((len(rows) - 1, len(self._columns)))
        pairs = zip(rows, rows[1:], substeps, found, strict=False)
        for before, after, number, out in pairs:
            self._step(before, after, number)
            out[self._columns] = read_state(self._model, self._data)
        return found

    def _step(
        self, before: NDArray[np.float64], after: NDArray[np.float64], substeps: int
    ) -> None:
        own = np.where(self._inputs, after[self._columns], before[self._columns])
        mujoco.mj_setState(self._model, self._data, own, STATE_SPEC)
        mujoco.mj_step(self._model, self._data, nstep=substeps)


class SnapshotSteps(StateSteps):
    """Takes snapshots of a model again, each from recorded states alone.

    Args:
        model: it is copied.
        parts: of the recorded states.
        kind: of the recorded snapshots.

    Raises:
        InvalidArgument: states or snapshots are not of this model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        parts: Mapping[str, slice],
        kind: np.dtype[Any],
    ) -> None:
        super().__init__(model, parts)
        check_layout(self._model, self._data, kind)
        self._source = SnapshotSource(self._model, self._data, kind)
        names = np.array([name.partition("[")[0] for name in column_names(kind)])
        self._unseen = np.zeros(len(names), bool)
        if "sensordata" in names:
            self._unseen[names == "sensordata"] = ~drawn_readings(self._model)
        paths = {"wrap_obj", "wrap_xpos"}.intersection(names.tolist())
        self._paths = [np.flatnonzero(names == name) for name in paths]

    def settled(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the numbers of a snapshot that is computed for a state."""
        own = state[self._columns]
        mujoco.mj_setState(self._model, self._data, own, STATE_SPEC)
        mujoco.mj_step1(self._model, self._data)
        return numbers_of(self._source.taken())

    def stepped(
        self, before: NDArray[np.float64], after: NDArray[np.float64], substeps: int
    ) -> NDArray[np.float64]:
        """Return the numbers of a snapshot as `mj_step` leaves it.

        Args:
            before: the state that the steps begin at.
            after: the state that holds their inputs.
            substeps: the physics steps.
        """
        self._step(before, after, substeps)
        return numbers_of(self._source.taken())

    def alike(
        self, recorded: NDArray[np.float64], found: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return what is recorded, but what is found where no frame depends on it.

        Points behind the last of all tendons' paths are left over from earlier paths,
        and of sensors only those that are drawn matter.

        Args:
            recorded: the numbers of a recorded snapshot.
            found: those of the one that was taken last.
        """
        unseen = self._unseen.copy()
        # Points that tendons may run over, and do not.
        unused = np.ones(2 * self._model.nwrap, bool)
        data = self._data
        for first, count in zip(data.ten_wrapadr, data.ten_wrapnum, strict=True):
            unused[first : first + count] = False
        for columns in self._paths:
            unseen[columns.reshape(len(unused), -1)[unused]] = True
        return np.where(unseen, found, recorded)


class LiveStates:
    """The states of a simulation that an environment drives, as rows of a recording.

    Args:
        model: the environment's.
        data: its.
        parts: of the recorded rows, as `TrajectoryReader.columns` has them.
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
        parts: Mapping[str, slice],
        *,
        is_settled: bool,
    ) -> None:
        self._model = model
        self._data = data
        self._columns = state_columns(model, parts)
        self._is_settled = is_settled

    def read(self, out: NDArray[np.float64]) -> None:
        """Write the state of this moment into a row."""
        out[self._columns] = read_state(self._model, self._data)

    def bring_to(self, row: NDArray[np.float64]) -> None:
        """Put the simulation into a recorded state, near which it is already.

        What the environment's last step left behind besides the state stays: bodies
        where they were one substep before.
        """
        mujoco.mj_setState(self._model, self._data, row[self._columns], STATE_SPEC)
        if self._is_settled:
            mujoco.mj_step1(self._model, self._data)

    def begin_at(self, row: NDArray[np.float64]) -> None:
        """Put the simulation into a recorded state just after a reset, as resets do.

        All that follows from that state is computed, as it is after a reset.
        """
        self.bring_to(row)
        if not self._is_settled:
            mujoco.mj_forward(self._model, self._data)
            # The solver's warm start is another one now.
            self.bring_to(row)


def live_snapshot(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    parts: Mapping[str, slice],
    kind: np.dtype[Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return state and snapshot of a simulation, as it is, as recordings hold them.

    Raises:
        InvalidArgument: what is recorded is not of this model.
    """
    check_layout(model, data, kind)
    columns = state_columns(model, parts)
    state = np.empty(len(columns))
    state[columns] = read_state(model, data)
    return state, numbers_of(SnapshotSource(model, data, kind).taken())


def numbers_of(rows: Any) -> NDArray[np.float64]:
    """Return a snapshot, or `(n,)` of them, as numbers, one behind the other."""
    arrays = [rows[name] for name in rows.dtype.names]
    return np.concatenate(
        [a.reshape(*rows.shape, -1).astype(np.float64) for a in arrays], axis=-1
    )


def column_names(kind: np.dtype[Any]) -> list[str]:
    """Return what each of the numbers is called: `geom_xpos[3, 2]`."""
    return [
        f"{name}{list(index)}"
        for name in kind.names or ()
        for index in np.ndindex(kind[name].shape)
    ]


def has_jumping_contacts(model: mujoco.MjModel) -> bool:
    """Tell whether anything can touch whose contacts do not move smoothly."""
    smooth = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in _SMOOTH]
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return bool((~np.isin(model.geom_type, smooth) & touching).any())


def turns_by_rk4(model: mujoco.MjModel) -> bool:
    """Tell whether quaternions are integrated by the method of Runge and Kutta."""
    kinds = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    by_rk4 = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    return bool(by_rk4 and np.isin(model.jnt_type, [int(k) for k in kinds]).any())


def _input_numbers(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which numbers of a state are inputs, in this MuJoCo's order."""
    user = int(mujoco.mjtState.mjSTATE_USER)
    parts = columns_of(state_dtype(model)).items()
    inputs = [np.full(p.stop - p.start, bool(STATE_BITS[n] & user)) for n, p in parts]
    return np.concatenate(inputs)

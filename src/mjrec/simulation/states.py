# SPDX-License-Identifier: Apache-2.0
"""The state of a simulation, and functions that read, set and preserve it.

The state is `mjSTATE_INTEGRATION`: everything on which the next step depends. MuJoCo
returns the state as one vector whose components are identified by bits. The bits have
been renumbered between releases, so recordings identify components by name.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import columns_of, packed
from .raw_memory import WORDS, address_of, can_be_gathered, raw_memory, words_of

STATE_SPEC = int(mujoco.mjtState.mjSTATE_INTEGRATION)

_PREFIX = "mjSTATE_"

# The components whose arrays in `MjData` have different names.
_STATE_ARRAYS = {"warmstart": "qacc_warmstart", "plugin": "plugin_state"}
# The time is a plain number in the struct, close to this array.
_NEIGHBOUR, _REACH = "energy", 16

# Fields that an environment changes to mark a goal or a contact.
_SHOWING = (
    *("site_pos", "site_quat", "site_size", "site_rgba"),
    *("geom_pos", "geom_quat", "geom_size", "geom_rgba"),
    *("body_pos", "body_quat", "mat_rgba"),
)


def _elementary_bits() -> dict[str, int]:
    """Return the individual bits of `STATE_SPEC` by name, in MuJoCo's order.

    Combinations of several bits (`mjSTATE_PHYSICS`) are left out.
    """
    values = {
        name.removeprefix(_PREFIX).lower(): int(value)
        for name, value in mujoco.mjtState.__members__.items()
        # mjNSTATE is the number of bits, not a bit.
        if name.startswith(_PREFIX)
    }
    bits = {n: v for n, v in values.items() if v & STATE_SPEC and v.bit_count() == 1}
    return dict(sorted(bits.items(), key=lambda item: item[1]))


STATE_BITS = _elementary_bits()


def state_dtype(model: mujoco.MjModel) -> np.dtype[Any]:
    """Return the dtype of a state of `model`, with components in MuJoCo's order.

    Components that are empty for this model, such as `act`, are left out.
    """
    sizes = {name: mujoco.mj_stateSize(model, bit) for name, bit in STATE_BITS.items()}
    return packed((name, ("<f8", (size,))) for name, size in sizes.items() if size)


def read_state(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return the state of `data`."""
    state = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, state, STATE_SPEC)
    return state


def state_words(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.intp] | None:
    """Return the indices of the state of `data` in `raw_memory.WORDS`.

    The caller must keep `data` alive. The words are compared with the result of
    `mj_getState`, so no MuJoCo header has to be trusted.

    Returns:
        The indices, or None if a component's array has another type (`eq_active`), is
        unknown, or cannot be gathered.
    """
    arrays = []
    for part in state_dtype(model).names or ():
        name = _STATE_ARRAYS.get(part, part)
        array = _time(data) if name == "time" else getattr(data, name, None)
        if array is None or array.dtype != np.float64:
            return None
        arrays.append(array)
    if not can_be_gathered(arrays):
        return None
    words = words_of(arrays)
    is_state = WORDS.take(words).tobytes() == read_state(model, data).tobytes()
    return words if is_state else None


def _time(data: mujoco.MjData) -> NDArray[np.float64]:
    raw = raw_memory(address_of(getattr(data, _NEIGHBOUR)) + _time_offset(), 8)
    return np.frombuffer(memoryview(raw), np.float64)


@functools.cache
def _time_offset() -> int:
    """Find the offset between the time and its neighbor by setting the time."""
    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    start = address_of(getattr(data, _NEIGHBOUR)) - _REACH
    near = np.frombuffer(memoryview(raw_memory(start, 3 * _REACH)), np.float64)
    data.time = 1 / 3
    offset: int = 8 * near.tolist().index(data.time)
    return offset - _REACH


def state_columns(
    model: mujoco.MjModel, parts: Mapping[str, slice]
) -> NDArray[np.intp]:
    """Return the columns of a recorded row that form a state in this MuJoCo version.

    Raises:
        InvalidArgument: a component is unknown to this MuJoCo version, or has a
            different length in this model.
    """
    own = columns_of(state_dtype(model))
    if _lengths(parts) == _lengths(own):
        return np.concatenate([np.r_[parts[name]] for name in own])
    unknown = sorted(parts.keys() - STATE_BITS.keys())
    if unknown:
        raise InvalidArgument(
            f"The state contains {', '.join(unknown)}, which MuJoCo "
            f"{mujoco.__version__} lacks. Use the MuJoCo version that recorded "
            "it, or a later version."
        )
    recorded, here = _lengths(parts), _lengths(own)
    differences = [
        f"{name} has {recorded.get(name, 0)}, not {here.get(name, 0)} as in this model"
        for name in STATE_BITS
        if recorded.get(name, 0) != here.get(name, 0)
    ]
    raise InvalidArgument(
        "The state does not belong to this model: the components differ in length "
        f"({'; '.join(differences)}). Use the model that was recorded "
        "(`trajectory.model()`)."
    )


def _lengths(parts: Mapping[str, slice]) -> dict[str, int]:
    return {name: part.stop - part.start for name, part in parts.items()}


def set_state(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    parts: Mapping[str, slice],
    row: NDArray[np.float64],
) -> None:
    """Write a recorded state from any MuJoCo version into `data`.

    Quantities derived from the state (body positions, contacts) are not computed. If
    the state does not fit, `data` is not changed.

    Args:
        model: the model of `data`.
        data: the data to change.
        parts: the columns of each component in `row`.
        row: the state, `(n,) float64`.

    Raises:
        InvalidArgument: the row is not a state of this model.
    """
    columns = state_columns(model, parts)
    values = np.asarray(row, np.float64)
    if values.ndim != 1 or len(values) < len(columns):
        raise InvalidArgument(
            f"A state of this model has {len(columns)} numbers, but this array has the "
            f"shape {values.shape}."
        )
    mujoco.mj_setState(model, data, values[columns], STATE_SPEC)


def enter_state(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    parts: Mapping[str, slice],
    row: NDArray[np.float64],
) -> None:
    """Write a reset's recorded state into `data`, and compute derived quantities.

    Args:
        model: the model of `data`.
        data: the data to change.
        parts: the columns of each component in `row`.
        row: the state, `(n,) float64`.

    Raises:
        InvalidArgument: the row is not a state of this model.
    """
    set_state(model, data, parts, row)
    mujoco.mj_forward(model, data)
    # `mj_forward` may have changed the warm start.
    set_state(model, data, parts, row)


def turns_by_rk4(model: mujoco.MjModel) -> bool:
    """Return whether the model uses RK4 (Runge-Kutta) to integrate quaternions."""
    kinds = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    is_rk4 = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    return bool(is_rk4 and np.isin(model.jnt_type, [int(k) for k in kinds]).any())


class PreservedState:
    """The state of a simulation, preserved across a `with` block.

    After the block, all data is restored, and so are the positions, sizes and colors of
    the model's sites, geoms and bodies. The arrays keep their addresses.
    """

    def __init__(self) -> None:
        self._model: mujoco.MjModel | None = None
        self._scratch: mujoco.MjData | None = None

    @contextlib.contextmanager
    def around(self, model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[None]:
        """Preserve `model` and `data` across the block, even if it raises an error.

        Not reentrant.
        """
        if self._model is not model:
            # Creating an MjData takes as long as a hundred copies.
            self._scratch, self._model = mujoco.MjData(model), model
        fields = [getattr(model, name) for name in _SHOWING]
        before = [field.copy() for field in fields]
        mujoco.mj_copyData(self._scratch, model, data)
        try:
            yield
        finally:
            mujoco.mj_copyData(data, model, self._scratch)
            for field, values in zip(fields, before, strict=True):
                field[...] = values

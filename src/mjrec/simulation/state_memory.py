# SPDX-License-Identifier: Apache-2.0
"""The physics state as the memory in which a simulation has it.

`mj_getState` copies a state's components one behind the other. Their memory stays where
it is for as long as the data lives, so that a row can be gathered from it in one call,
together with the snapshot (`gathering`). That the memory holds what `mj_getState` gives
is tried on data of our own, not taken from a release's headers.
"""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .integration_state import STATE_SPEC, state_components
from .struct_memory import Memory, Place, array_address, find_places

# Components whose array in `MjData` has another name.
_ARRAYS = {"warmstart": "qacc_warmstart", "plugin": "plugin_state"}
# No array, but a number of the struct, which lies close to this array of the struct.
_TIME, _NEIGHBOUR = "time", "energy"
_MARGIN = 16


def has_state_memory(model: mujoco.MjModel) -> bool:
    """Tell whether `state_memory` gives, for data of `model`, what `mj_getState` does.

    It does not where a component is kept as another type than it is given as
    (`eq_active`), or is new in MuJoCo.
    """
    data = mujoco.MjData(model)
    size = mujoco.mj_stateSize(model, STATE_SPEC)
    # Numbers that differ from each other, and from those that a model begins with.
    state = np.linspace(0.25, 0.75, size)
    mujoco.mj_setState(model, data, state, STATE_SPEC)
    try:
        memory = state_memory(model, data)
    except (AttributeError, LookupError, TypeError):
        return False
    given = np.empty(size)
    mujoco.mj_getState(model, data, given, STATE_SPEC)
    held = b"".join(array.tobytes() for array in memory)
    return held == given.tobytes() == state.tobytes()


def state_memory(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[NDArray[np.float64], ...]:
    """Return the memory of the state's components, in their order.

    Args:
        model: one for which `has_state_memory` is true.
        data: its data, to be kept alive for as long as the memory is used.
    """
    names = [part.name for part in state_components(model)]
    return tuple(
        _time(data) if name == _TIME else _array(data, name).reshape(-1)
        for name in names
    )


def _array(data: mujoco.MjData, component: str) -> NDArray[Any]:
    array: NDArray[Any] = getattr(data, _ARRAYS.get(component, component))
    return array


def _time(data: mujoco.MjData) -> NDArray[np.float64]:
    address = array_address(data.energy) + _time_offset()
    memory = memoryview(Memory(address, [Place(_TIME, 0, 8)]).raw)
    return np.frombuffer(memory, np.float64)


@functools.cache
def _time_offset() -> int:
    """Return where the time lies, from a neighbour in the struct on."""
    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    start = array_address(getattr(data, _NEIGHBOUR)) - _MARGIN
    places = find_places(data, [_TIME], start=start, stop=start + 3 * _MARGIN)
    if not places:
        raise LookupError(_TIME)
    return places[0].start - _MARGIN

# SPDX-License-Identifier: Apache-2.0
"""The physics state, taken apart by the names of its components.

`mjSTATE_INTEGRATION` is everything that the next step depends on, the solver's warm
start included. MuJoCo gives it as one vector, whose parts are numbered by bits; the
bits were renumbered between releases, so that what is kept goes by names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import StateComponent

STATE_SPEC = int(mujoco.mjtState.mjSTATE_INTEGRATION)

_PREFIX = "mjSTATE_"


def _elementary_bits() -> dict[str, int]:
    """Return the bits inside `STATE_SPEC` by their names, in MuJoCo's order.

    Combinations of several bits (`mjSTATE_PHYSICS`) are left out.
    """
    values = {
        name.removeprefix(_PREFIX).lower(): int(value)
        for name, value in mujoco.mjtState.__members__.items()
        # mjNSTATE is a number of bits, not one of them.
        if name.startswith(_PREFIX)
    }
    bits = {n: v for n, v in values.items() if v & STATE_SPEC and v.bit_count() == 1}
    return dict(sorted(bits.items(), key=lambda item: item[1]))


_BITS = _elementary_bits()


def state_components(model: mujoco.MjModel) -> tuple[StateComponent, ...]:
    """Return what the state of `model` consists of, in the order of its vector.

    Components that this model has none of (`act` without activations) are left out.
    """
    components: list[StateComponent] = []
    offset = 0
    for name, length in _lengths(model).items():
        components.append(StateComponent(name, offset, length))
        offset += length
    return tuple(components)


def set_state(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    components: Sequence[StateComponent],
    row: NDArray[np.float64],
) -> None:
    """Put a recorded state into `data`, whichever MuJoCo it was recorded by.

    What follows from the state (positions of bodies, contacts) is not computed.
    Nothing is set where anything does not fit.

    Args:
        model: the model of `data`.
        data: what is set.
        components: where the parts of the state are in `row`.
        row: the state, `(n,) float64`.

    Raises:
        InvalidArgument: a component is unknown to this MuJoCo, or this model has
            another number of it, or `row` is too short.
    """
    _check_components(_lengths(model), components)
    values = np.asarray(row, np.float64)
    needed = max((c.offset + c.length for c in components), default=0)
    if values.ndim != 1 or len(values) < needed:
        raise InvalidArgument(
            f"A state of this model is {needed} numbers, got an array of shape "
            f"{values.shape}."
        )
    for part in components:
        numbers = np.ascontiguousarray(values[part.offset : part.offset + part.length])
        mujoco.mj_setState(model, data, numbers, _BITS[part.name])


def _lengths(model: mujoco.MjModel) -> dict[str, int]:
    sizes = {name: mujoco.mj_stateSize(model, bit) for name, bit in _BITS.items()}
    return {name: size for name, size in sizes.items() if size > 0}


def _check_components(
    lengths: Mapping[str, int], components: Sequence[StateComponent]
) -> None:
    given = {part.name: part.length for part in components}
    if given == lengths and len(given) == len(components):
        return
    unknown = sorted(given.keys() - _BITS.keys())
    if unknown:
        raise InvalidArgument(
            f"The state holds {', '.join(unknown)}, which MuJoCo {mujoco.__version__} "
            "does not know; use the MuJoCo version that recorded it, or a later one."
        )
    differences = [
        f"{name}: {given.get(name, 0)}, and this model has {lengths.get(name, 0)}"
        for name in _BITS
        if given.get(name, 0) != lengths.get(name, 0)
    ]
    raise InvalidArgument(
        "The state is not one of this model. How many numbers it holds: "
        f"{'; '.join(differences) or 'some twice'}. Use the model that it was recorded "
        "with (`trajectory.model()`)."
    )

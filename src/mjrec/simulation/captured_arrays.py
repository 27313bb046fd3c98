# SPDX-License-Identifier: Apache-2.0
"""What a row of a recording holds of a simulation, and where that lies in memory.

A row has two parts. The state is `mjSTATE_INTEGRATION`, everything that the next step
depends on. MuJoCo gives it as one vector, whose parts are numbered by bits; the bits
were renumbered between releases, so that what is kept goes by names.

The snapshot is what a frame is drawn from: some twenty of the hundred and more arrays
of `MjData`. They do not follow from the state alone: after a step they belong to the
state before its last substep, and environments move things just before they draw.
"""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..formats.trajectory import packed
from .raw_memory import WORDS, address_of, can_be_gathered, raw_memory, words_of

STATE_SPEC = int(mujoco.mjtState.mjSTATE_INTEGRATION)

_PREFIX = "mjSTATE_"
_JOINT_WRAP = int(mujoco.mjtWrap.mjWRAP_JOINT)

# Components whose array in `MjData` has another name.
_STATE_ARRAYS = {"warmstart": "qacc_warmstart", "plugin": "plugin_state"}
# The time is no array but a number of the struct, which lies close to this one.
_NEIGHBOUR, _REACH = "energy", 16

# Not an array of `MjData`: the colours that tendons have in the frame. They are
# restored into the model's array of this name.
TENDON_RGBA = "tendon_rgba"

# What any camera may need with MuJoCo's default option, wherever there is any of it.
ALWAYS = (
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat"),
    *("light_xpos", "light_xdir", "subtree_com", "flexvert_xpos"),
    *("ten_wrapadr", "ten_wrapnum", "ten_length", "wrap_obj", "wrap_xpos"),
)
_FOR_SKINS = ("xpos", "xquat")
# What flags, frames and labels that are off by default may need besides.
_FOR_OPTIONS = (
    *("xpos", "xmat", "xipos", "ximat", "xanchor", "xaxis", "ctrl", "act"),
    *("eq_active", "xfrc_applied", "bvh_active", "bvh_aabb_dyn"),
)

# Nothing else is put into data from a file.
SNAPSHOT_ARRAYS = frozenset(
    (*ALWAYS, *_FOR_SKINS, *_FOR_OPTIONS, "sensordata", "plastic")
)

# Read from the constraints of a step, which cannot be put into fresh data.
_CONSTRAINT_FLAGS = ("mjVIS_CONTACTPOINT", "mjVIS_CONTACTFORCE", "mjVIS_CONTACTSPLIT")

# Sensors whose reading is drawn: as rays.
_DRAWN_SENSORS = ("mjSENS_RANGEFINDER", "mjSENS_GEOMFROMTO")


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


STATE_BITS = _elementary_bits()


def state_dtype(model: mujoco.MjModel) -> np.dtype[Any]:
    """Return what the state of `model` consists of, in the order of its vector.

    Components that this model has none of (`act` without activations) are left out.
    """
    sizes = {name: mujoco.mj_stateSize(model, bit) for name, bit in STATE_BITS.items()}
    return packed((name, ("<f8", (size,))) for name, size in sizes.items() if size)


def read_state(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return the state of `data`."""
    state = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
    mujoco.mj_getState(model, data, state, STATE_SPEC)
    return state


def state_words(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.intp] | None:
    """Return which of `memory.WORDS` are the state of `data`, which is kept alive.

    That they hold what `mj_getState` gives is tried, not taken from a header.

    Returns:
        None where a component is kept as another type than it is given as
        (`eq_active`), or is new in MuJoCo.
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
    """Return where the time lies, from its neighbour on, by setting it."""
    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    start = address_of(getattr(data, _NEIGHBOUR)) - _REACH
    near = np.frombuffer(memoryview(raw_memory(start, 3 * _REACH)), np.float64)
    data.time = 1 / 3
    offset: int = 8 * near.tolist().index(data.time)
    return offset - _REACH


def snapshot_dtype(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    option: mujoco.MjvOption | None = None,
) -> np.dtype[Any]:
    """Return what of a simulation's data a snapshot holds.

    Everything that the default option and any camera needs, and what `option` needs
    besides, as far as the model has any of it.

    Args:
        model: the model.
        data: its data.
        option: how it is shown; None is MuJoCo's default.
    """
    names = set(ALWAYS)
    if model.nskin:
        names.update(_FOR_SKINS)
    # Of tendons whose spring can yield, which mujoco 4 brought.
    if (getattr(model, "tendon_plasticadr", np.empty(0)) >= 0).any():
        names.add("plastic")
    # Not `np.isin`, whose first call loads numpy's masked arrays (100 ms).
    if not _drawn_sensors().isdisjoint(model.sensor_type.tolist()):
        names.add("sensordata")
    if option is not None and _shows_more(option):
        names.update(_FOR_OPTIONS)
    held = [name for name in names if array_kind(data, name) is not None]
    # In the order of the memory, which is read faster so.
    held.sort(key=lambda name: address_of(getattr(data, name)))
    arrays = [(name, array_kind(data, name)) for name in held]
    if has_limited_tendons(model):
        arrays.append((TENDON_RGBA, array_kind(model, TENDON_RGBA)))
    return packed(arrays)


def array_kind(holder: Any, name: str) -> np.dtype[Any] | None:
    """Return the kind of an array of a model or of data; None where it is empty."""
    # `bvh_active` and others are not in every version.
    array = getattr(holder, name, None)
    if array is None or not array.size:
        return None
    return np.dtype(("|u1" if array.dtype == bool else array.dtype.str, array.shape))


def has_limited_tendons(model: mujoco.MjModel) -> bool:
    """Tell whether a tendon may be drawn in another colour than the model's."""
    if not model.ntendon:
        return False
    spatial = model.wrap_type[model.tendon_adr] != _JOINT_WRAP
    plain = model.tendon_matid < 0
    return bool((spatial & plain & (model.tendon_limited != 0)).any())


def needs_constraints(model: mujoco.MjModel, option: mujoco.MjvOption) -> str | None:
    """Say what `option` shows that no snapshot holds; None if there is nothing.

    Contacts, constraint islands and joints at their limits are drawn from the
    constraints of a step.
    """
    shown = [name for name in _CONSTRAINT_FLAGS if _flag(option, name)]
    if _flag(option, "mjVIS_ISLAND") and _has_islands(model):
        shown.append("mjVIS_ISLAND")
    if _flag(option, "mjVIS_JOINT") and model.jnt_limited.any():
        shown.append("mjVIS_JOINT")
    if option.frame == int(mujoco.mjtFrame.mjFRAME_CONTACT):
        shown.append("mjFRAME_CONTACT")
    if option.label == int(mujoco.mjtLabel.mjLABEL_ISLAND):
        shown.append("mjLABEL_ISLAND")
    if not shown:
        return None
    return (
        f"{' and '.join(shown)} of the visual options show constraints (contacts, "
        "joints at their limits), which are gone once the step is over"
    )


def drawn_readings(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which numbers of `sensordata` frames may show."""
    drawn = np.zeros(model.nsensordata, bool)
    for index in range(model.nsensor):
        if int(model.sensor_type[index]) in _drawn_sensors():
            first = model.sensor_adr[index]
            drawn[first : first + model.sensor_dim[index]] = True
    return drawn


def _shows_more(option: mujoco.MjvOption) -> bool:
    """Tell whether an option shows anything that MuJoCo's default does not."""
    default = mujoco.MjvOption()
    return bool(
        (option.flags > default.flags).any()
        or option.frame != default.frame
        or option.label != default.label
    )


def _flag(option: mujoco.MjvOption, name: str) -> bool:
    index = getattr(mujoco.mjtVisFlag, name, None)
    return index is not None and bool(option.flags[int(index)])


def _has_islands(model: mujoco.MjModel) -> bool:
    """Tell whether islands of constraints are looked for in this model."""
    # In mujoco 3.3 they had to be enabled, and the flag that shows them was on.
    enabling = getattr(mujoco.mjtEnableBit, "mjENBL_ISLAND", None)
    if enabling is not None:
        return bool(model.opt.enableflags & int(enabling))
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


def _drawn_sensors() -> set[int]:
    kinds = [getattr(mujoco.mjtSensor, name, None) for name in _DRAWN_SENSORS]
    return {int(kind) for kind in kinds if kind is not None}

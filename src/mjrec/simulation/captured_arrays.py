# SPDX-License-Identifier: Apache-2.0
"""The arrays of a simulation that a snapshot must contain for drawing a frame.

These are about 20 of the more than 100 arrays in `MjData`. The state (see `states`)
alone does not determine them: after a step, they belong to the state before the last
substep, and environments may move objects just before drawing.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ..formats.trajectory import packed
from .raw_memory import address_of

_JOINT_WRAP = int(mujoco.mjtWrap.mjWRAP_JOINT)

# The colors of the tendons in the frame. `MjData` has no such array; the colors are
# restored into the model's array with this name.
TENDON_RGBA = "tendon_rgba"

# Arrays that any camera may need with MuJoCo's default option, if they are not empty.
ALWAYS = (
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat"),
    *("light_xpos", "light_xdir", "subtree_com", "flexvert_xpos"),
    *("ten_wrapadr", "ten_wrapnum", "ten_length", "wrap_obj", "wrap_xpos"),
)
_FOR_SKINS = ("xpos", "xquat")
# Additional arrays for flags, frames and labels that are off by default.
_FOR_OPTIONS = (
    *("xpos", "xmat", "xipos", "ximat", "xanchor", "xaxis", "ctrl", "act"),
    *("eq_active", "xfrc_applied", "bvh_active", "bvh_aabb_dyn"),
)

# No other array is ever copied from a file into an `MjData`.
SNAPSHOT_ARRAYS = frozenset(
    (*ALWAYS, *_FOR_SKINS, *_FOR_OPTIONS, "sensordata", "plastic")
)

# These flags draw a step's constraints, which cannot be put into a new `MjData`.
_CONSTRAINT_FLAGS = ("mjVIS_CONTACTPOINT", "mjVIS_CONTACTFORCE", "mjVIS_CONTACTSPLIT")

# Sensors whose readings are drawn as rays.
_DRAWN_SENSORS = ("mjSENS_RANGEFINDER", "mjSENS_GEOMFROMTO")


def snapshot_dtype(
    model: mujoco.MjModel, data: mujoco.MjData, option: mujoco.MjvOption | None = None
) -> np.dtype[Any]:
    """Return the dtype of a snapshot of a simulation's data.

    It includes all non-empty arrays that the default option needs with any camera, and
    those that `option` needs in addition.

    Args:
        model: the model.
        data: the model's data.
        option: the visual options of the frames; None for MuJoCo's default.
    """
    names = set(ALWAYS)
    if model.nskin:
        names.update(_FOR_SKINS)
    # For tendons whose springs can yield, which are new in mujoco 4.
    if (getattr(model, "tendon_plasticadr", np.empty(0)) >= 0).any():
        names.add("plastic")
    # Not `np.isin`, whose first call loads numpy's masked arrays (100 ms).
    if not _drawn_sensors().isdisjoint(model.sensor_type.tolist()):
        names.add("sensordata")
    if option is not None and _shows_more(option):
        names.update(_FOR_OPTIONS)
    held = [name for name in names if array_kind(data, name) is not None]
    # Reading in memory order is faster.
    held.sort(key=lambda name: address_of(getattr(data, name)))
    arrays = [(name, array_kind(data, name)) for name in held]
    if has_limited_tendons(model):
        arrays.append((TENDON_RGBA, array_kind(model, TENDON_RGBA)))
    return packed(arrays)


def array_kind(holder: Any, name: str) -> np.dtype[Any] | None:
    """Return the dtype and shape of an array of a model or data; None if empty."""
    # Some arrays, such as `bvh_active`, are not in every version.
    array = getattr(holder, name, None)
    if array is None or not array.size:
        return None
    return np.dtype(("|u1" if array.dtype == bool else array.dtype.str, array.shape))


def has_limited_tendons(model: mujoco.MjModel) -> bool:
    """Return whether a tendon may be drawn in a color different from the model's."""
    if not model.ntendon:
        return False
    spatial = model.wrap_type[model.tendon_adr] != _JOINT_WRAP
    plain = model.tendon_matid < 0
    return bool((spatial & plain & (model.tendon_limited != 0)).any())


def needs_constraints(model: mujoco.MjModel, option: mujoco.MjvOption) -> str | None:
    """Return the reason why snapshots are not enough for `option`, or None if they are.

    Contacts, constraint islands and joints at their limits are drawn from a step's
    constraints.
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
        f"{' and '.join(shown)} in the visual options show constraints (contacts, "
        "joints at their limits), which MuJoCo discards after the step"
    )


def _shows_more(option: mujoco.MjvOption) -> bool:
    """Return whether an option shows anything that MuJoCo's default does not."""
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
    """Return whether MuJoCo computes constraint islands for this model."""
    # In mujoco 3.3 islands had to be enabled, and the flag that shows them was on.
    enabling = getattr(mujoco.mjtEnableBit, "mjENBL_ISLAND", None)
    if enabling is not None:
        return bool(model.opt.enableflags & int(enabling))
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


def _drawn_sensors() -> set[int]:
    kinds = [getattr(mujoco.mjtSensor, name, None) for name in _DRAWN_SENSORS]
    return {int(kind) for kind in kinds if kind is not None}

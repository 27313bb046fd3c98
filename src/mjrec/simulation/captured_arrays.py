# SPDX-License-Identifier: Apache-2.0
"""Which arrays of a simulation a snapshot holds: what a frame is drawn from.

They are some twenty of the hundred and more arrays of `MjData`, and do not follow from
the state (`states`) alone: after a step they belong to the state before its last
substep, and environments move things just before they draw.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ..formats.trajectory import packed
from .raw_memory import address_of

_JOINT_WRAP = int(mujoco.mjtWrap.mjWRAP_JOINT)

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
    """Return whether a tendon may be drawn in another colour than the model's."""
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
    """Return whether islands of constraints are looked for in this model."""
    # In mujoco 3.3 they had to be enabled, and the flag that shows them was on.
    enabling = getattr(mujoco.mjtEnableBit, "mjENBL_ISLAND", None)
    if enabling is not None:
        return bool(model.opt.enableflags & int(enabling))
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


def _drawn_sensors() -> set[int]:
    kinds = [getattr(mujoco.mjtSensor, name, None) for name in _DRAWN_SENSORS]
    return {int(kind) for kind in kinds if kind is not None}

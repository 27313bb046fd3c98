# SPDX-License-Identifier: Apache-2.0
"""What a picture of a moment is made from, as one row of bytes.

MuJoCo's visualiser reads some twenty of the hundred and more arrays of `MjData`. They
are copied as they are in the moment of the picture, because they do not follow from
the physics state alone: after a step they belong to the state before its last substep,
and environments move things just before they draw. Restored into fresh data they give
the same scene, byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import Array, RowLayout
from .gathering import WORDS, can_be_gathered, words_of
from .tendon_colours import TendonColours, has_limited_tendons, has_plastic_tendons

# Not an array of `MjData`: the colours that tendons have in the picture. They are
# restored into the model's array of this name.
_TENDON_RGBA = "tendon_rgba"
_COLOUR = "<f4"

# Arrays of `MjData` in the order in which it has them: type, the size of the model that
# is their length, and the numbers in a row.
_ARRAYS: dict[str, tuple[str, str, tuple[int, ...]]] = {
    "act": ("<f8", "na", ()),
    "plastic": ("<f8", "nplastic", ()),
    "ctrl": ("<f8", "nu", ()),
    "xfrc_applied": ("<f8", "nbody", (6,)),
    "eq_active": ("|u1", "neq", ()),
    "sensordata": ("<f8", "nsensordata", ()),
    "xpos": ("<f8", "nbody", (3,)),
    "xquat": ("<f8", "nbody", (4,)),
    "xmat": ("<f8", "nbody", (9,)),
    "xipos": ("<f8", "nbody", (3,)),
    "ximat": ("<f8", "nbody", (9,)),
    "xanchor": ("<f8", "njnt", (3,)),
    "xaxis": ("<f8", "njnt", (3,)),
    "geom_xpos": ("<f8", "ngeom", (3,)),
    "geom_xmat": ("<f8", "ngeom", (9,)),
    "site_xpos": ("<f8", "nsite", (3,)),
    "site_xmat": ("<f8", "nsite", (9,)),
    "cam_xpos": ("<f8", "ncam", (3,)),
    "cam_xmat": ("<f8", "ncam", (9,)),
    "light_xpos": ("<f8", "nlight", (3,)),
    "light_xdir": ("<f8", "nlight", (3,)),
    "subtree_com": ("<f8", "nbody", (3,)),
    "flexvert_xpos": ("<f8", "nflexvert", (3,)),
    "bvh_aabb_dyn": ("<f8", "nbvhdynamic", (6,)),
    "ten_wrapadr": ("<i4", "ntendon", ()),
    "ten_wrapnum": ("<i4", "ntendon", ()),
    "ten_length": ("<f8", "ntendon", ()),
    "wrap_obj": ("<i4", "nwrap", (2,)),
    "wrap_xpos": ("<f8", "nwrap", (6,)),
    "bvh_active": ("|u1", "nbvh", ()),
}

# What any camera may need with MuJoCo's default option, wherever there is any of it.
_ALWAYS = (
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat"),
    *("light_xpos", "light_xdir", "subtree_com", "flexvert_xpos"),
    *("ten_wrapadr", "ten_wrapnum", "ten_length", "wrap_obj", "wrap_xpos"),
)
# Of these, some are indices of others and of geoms.
_PATHS = ("ten_wrapadr", "ten_wrapnum", "wrap_obj")
# In the place of a geom.
_PULLEY = -2
_FOR_SKINS = ("xpos", "xquat")
_BODIES = ("xpos", "xmat", "xipos", "ximat")

# What a flag that is off by default needs besides.
_FOR_FLAGS: dict[str, tuple[str, ...]] = {
    "mjVIS_JOINT": ("xanchor", "xaxis", "xmat"),
    "mjVIS_ACTUATOR": ("ctrl", "xanchor", "xaxis", "xmat"),
    "mjVIS_ACTIVATION": ("act",),
    "mjVIS_CONSTRAINT": ("eq_active", "xpos", "xmat"),
    "mjVIS_INERTIA": ("xipos", "ximat"),
    "mjVIS_SCLINERTIA": ("xipos", "ximat"),
    "mjVIS_PERTFORCE": ("xfrc_applied", "xipos"),
    "mjVIS_SELECT": _BODIES,
    "mjVIS_AUTOCONNECT": ("xanchor", "xipos"),
    "mjVIS_BODYBVH": ("xipos", "ximat", "bvh_active"),
    # Until mujoco 3.3 on their own.
    "mjVIS_FLEXBVH": ("bvh_aabb_dyn", "bvh_active", "xpos", "xmat"),
    "mjVIS_MESHBVH": ("bvh_aabb_dyn", "bvh_active", "xpos", "xmat"),
}
_FRAMES_OF_BODIES = ("mjFRAME_BODY", "mjFRAME_WORLD")

# Read from the constraints of a step, which cannot be put into fresh data.
_CONSTRAINT_FLAGS = ("mjVIS_CONTACTPOINT", "mjVIS_CONTACTFORCE", "mjVIS_CONTACTSPLIT")

# Sensors whose reading is drawn: as rays.
_DRAWN_SENSORS = ("mjSENS_RANGEFINDER", "mjSENS_GEOMFROMTO")


def snapshot_layout(
    model: mujoco.MjModel, option: mujoco.MjvOption | None = None
) -> RowLayout:
    """Return what of a simulation's data a snapshot holds.

    Everything that the default option and any camera needs, and what `option` needs
    besides, as far as the model has any of it.

    Args:
        model: the model.
        option: how it is shown; None is MuJoCo's default.
    """
    names = set(_ALWAYS)
    if model.nskin:
        names.update(_FOR_SKINS)
    if has_plastic_tendons(model):
        names.add("plastic")
    if _has_sensor(model, _DRAWN_SENSORS):
        names.add("sensordata")
    if option is not None:
        names.update(_for_option(option))
    arrays = [(name, _array(model, name)) for name in _ARRAYS if name in names]
    if has_limited_tendons(model):
        arrays.append((_TENDON_RGBA, Array(_COLOUR, (model.ntendon, 4))))
    return RowLayout.packed((name, array) for name, array in arrays if array.size)


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


def layout_objection(model: mujoco.MjModel, layout: RowLayout) -> str | None:
    """Say why recorded snapshots are none of this model; None if they may be.

    They hold at least what MuJoCo's default option needs.
    """
    for field in layout.fields:
        is_colour = field.name == _TENDON_RGBA
        if not is_colour and field.name not in _ARRAYS:
            return f"The snapshots hold {field.name!r:.40}, which no picture needs."
        own = (
            Array(_COLOUR, (model.ntendon, 4))
            if is_colour
            else _array(model, field.name)
        )
        if (field.array.dtype, field.array.shape) != (own.dtype, own.shape):
            return (
                f"The snapshots' {field.name} is {field.array.dtype} of the shape "
                f"{field.array.shape}, and in this model {own.dtype} of {own.shape}."
            )
    held = {field.name for field in layout.fields}
    needed = {name for name in _ALWAYS if _array(model, name).size}
    if needed - held:
        return f"The snapshots hold no {', no '.join(sorted(needed - held))}."
    return None


def drawn_readings(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which numbers of `sensordata` pictures may show."""
    drawn = np.zeros(model.nsensordata, bool)
    for index in range(model.nsensor):
        if int(model.sensor_type[index]) in _sensor_numbers(_DRAWN_SENSORS):
            first = model.sensor_adr[index]
            drawn[first : first + model.sensor_dim[index]] = True
    return drawn


def restore_snapshot(
    values: Mapping[str, NDArray[Any]], model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    """Put what a snapshot holds back, ready for `mjv_updateScene`.

    Args:
        values: the arrays by their names, as `RowLayout.unpack` gives them.
        model: the colours of its tendons are set where `values` has them.
        data: its data.

    Raises:
        InvalidArgument: an array is not there, is of another kind, or leads to where
            the model has nothing, which MuJoCo would not notice.
    """
    for name, value in values.items():
        target = model if name == _TENDON_RGBA else data
        dtype = _COLOUR if name == _TENDON_RGBA else _ARRAYS.get(name, ("",))[0]
        present = getattr(target, name, None) if dtype else None
        if (
            present is None
            or present.shape != value.shape
            or value.dtype != np.dtype(dtype)
        ):
            shape = None if present is None else present.shape
            raise InvalidArgument(
                f"The snapshot's {name} is {value.dtype} of the shape {value.shape}, "
                f"and here it is {dtype or None} of the shape {shape}: it belongs to "
                "another model or version of MuJoCo."
            )
        present[...] = value
    if not values.keys().isdisjoint(_PATHS):
        _check_paths(model, data)


def _check_paths(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check what the visualiser follows, unseen, along a tendon."""
    first, count = data.ten_wrapadr.astype(np.int64), data.ten_wrapnum
    points, wrapped = 2 * model.nwrap, data.wrap_obj
    ends = first + count
    if ((count < 0) | (first < 0) | (ends > points))[count != 0].any():
        raise InvalidArgument(
            f"The snapshot's tendons run over points up to {ends.max()}, and this "
            f"model has {points}."
        )
    if wrapped.size and (wrapped.min() < _PULLEY or wrapped.max() >= model.ngeom):
        raise InvalidArgument(
            f"The snapshot's wrap_obj holds geoms from {_PULLEY} (a pulley) and -1 (a "
            f"site) to {model.ngeom - 1} in this model, and there are some from "
            f"{wrapped.min()} to {wrapped.max()}."
        )


class SnapshotSource:
    """Takes snapshots of one `MjData`.

    Args:
        model: the model; kept alive, as is the data.
        data: its data.
        layout: what `snapshot_layout` gave for the model.

    Attributes:
        arrays: what a snapshot consists of, in its order.
        words: the same in `gathering.WORDS`; None where it cannot be gathered.
        is_plain: all of it is the data's own; else `take` brings it up to date.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, layout: RowLayout
    ) -> None:
        self.data = data
        self._colours: TendonColours | None = None
        arrays = []
        for field in layout.fields:
            if field.name == _TENDON_RGBA:
                self._colours = TendonColours(model, data)
                arrays.append(self._colours.rgba)
            else:
                arrays.append(getattr(data, field.name))
        self.is_plain = self._colours is None
        self.arrays = tuple(arrays)
        self.words = words_of(arrays) if can_be_gathered(arrays) else None
        self._fields = layout.fields

    def take(self, out: NDArray[np.uint8]) -> None:
        """Write a snapshot of this moment into `out`, `(layout.size,) uint8`.

        It begins at a multiple of 8 bytes.
        """
        if self._colours is not None:
            self._colours.update()
        if self.words is not None:
            WORDS.take(self.words, None, out.view(np.uint64), "clip")
            return
        for field, array in zip(self._fields, self.arrays, strict=True):
            part = out[field.offset : field.offset + field.array.size]
            part[...] = array.reshape(-1).view(np.uint8)


def _array(model: mujoco.MjModel, name: str) -> Array:
    dtype, size, row = _ARRAYS[name]
    # `nplastic` and others are not in every version.
    return Array(dtype, (int(getattr(model, size, 0)), *row))


def _for_option(option: mujoco.MjvOption) -> set[str]:
    names = {
        name
        for flag, needed in _FOR_FLAGS.items()
        if _flag(option, flag)
        for name in needed
    }
    frames = [int(getattr(mujoco.mjtFrame, name)) for name in _FRAMES_OF_BODIES]
    if option.frame in frames or option.label != int(mujoco.mjtLabel.mjLABEL_NONE):
        names.update(_BODIES)
    return names


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


def _has_sensor(model: mujoco.MjModel, names: tuple[str, ...]) -> bool:
    # Not `np.isin`, whose first call loads numpy's masked arrays (100 ms).
    return not _sensor_numbers(names).isdisjoint(model.sensor_type.tolist())


def _sensor_numbers(names: tuple[str, ...]) -> set[int]:
    kinds = [getattr(mujoco.mjtSensor, name, None) for name in names]
    return {int(kind) for kind in kinds if kind is not None}

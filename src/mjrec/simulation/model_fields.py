# SPDX-License-Identifier: Apache-2.0
"""The fields of a model by their names, as a trajectory's model changes hold them."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from .struct_memory import member_names, read_member

# What in a name's first part stands for the view and not for the model.
VIEW_STRUCTS = ("camera", "option")

_MODEL_STRUCTS = ("opt", "vis", "stat")


@functools.cache
def array_names() -> tuple[str, ...]:
    """Return the names of all arrays of `MjModel`, in this version of MuJoCo."""
    model = empty_model()
    names = (name for name in dir(model) if not name.startswith("_"))
    return tuple(n for n in names if isinstance(getattr(model, n), np.ndarray))


@functools.cache
def struct_names() -> tuple[str, ...]:
    """Return the names of all members of `opt`, `vis` and `stat`, with these prefixes.

    Members that the bindings cannot read (`vis.rgba.bv`) are not among them.
    """
    model = empty_model()
    return tuple(
        f"{struct}.{name}"
        for struct in _MODEL_STRUCTS
        for name in member_names(getattr(model, struct))
    )


@functools.cache
def view_names() -> tuple[str, ...]:
    """Return the names of all members of a camera and of an option, with prefixes."""
    structs = {"camera": mujoco.MjvCamera(), "option": mujoco.MjvOption()}
    return tuple(f"{k}.{name}" for k, v in structs.items() for name in member_names(v))


@functools.cache
def empty_model() -> mujoco.MjModel:
    """Return a model with nothing in it, which is not to be changed."""
    return mujoco.MjModel.from_xml_string("<mujoco/>")


def read_fields(model: mujoco.MjModel, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Return copies of fields of a model.

    Args:
        model: the model.
        names: arrays of `MjModel` (`geom_rgba`), and members of its structs
            (`opt.gravity`, `vis.headlight.ambient`, `vis.global_.fovy`, `stat.extent`).

    Returns:
        The values by their names; a single number as an array without dimensions.
    """
    return {name: read_member(model, name) for name in names}


def apply_fields(
    model: mujoco.MjModel,
    fields: Mapping[str, NDArray[Any]],
    *,
    camera: mujoco.MjvCamera | None = None,
    option: mujoco.MjvOption | None = None,
) -> None:
    """Set fields of a model, and of a view.

    Args:
        model: the model to change.
        fields: values by names, as `read_fields` gives them, and names of the view:
            `camera.lookat`, `option.flags` ...
        camera: what names that begin with `camera.` are set in; without it they are
            left out.
        option: likewise for `option.`.

    Raises:
        InvalidArgument: there is no such field, it has another shape, or it is none
            that `is_settable`. Fields before it have been set then.
    """
    targets = {"camera": camera, "option": option}
    for name, value in fields.items():
        _check_name(name)
        struct, _, member = name.partition(".")
        if struct not in VIEW_STRUCTS:
            _set(model, name, value, field=name)
        elif targets[struct] is not None:
            _set(targets[struct], member, value, field=name)


@functools.cache
def _all_names() -> frozenset[str]:
    return frozenset((*array_names(), *struct_names(), *view_names()))


def is_settable(name: str) -> bool:
    """Tell whether a field of a model may be set to what a file says.

    MuJoCo trusts types, addresses and most indices in a model: a wrong one makes it
    read foreign memory. Numbers with a point, flags, colours of textures and indices
    that can be checked are settable.
    """
    if "." in name or name in _INDICES or _INTEGERS.fullmatch(name):
        return True
    return getattr(empty_model(), name).dtype in _HARMLESS_TYPES


_HARMLESS_TYPES = ("<f4", "<f8", "|u1", "|b1")
_INTEGERS = re.compile(r"\w+_(contype|conaffinity|group|condim|priority)")

# Indices by the size of the model that they have to be less than; -1 is none.
_INDICES = {
    **dict.fromkeys(
        ("geom_matid", "site_matid", "skin_matid", "flex_matid", "tendon_matid"), "nmat"
    ),
    "mat_texid": "ntex",
    "light_texid": "ntex",
}


def _check_name(name: str) -> None:
    # Names may come from a file: nothing else is ever looked up or set.
    if name not in _all_names():
        raise InvalidArgument(
            f"MuJoCo {mujoco.__version__} has no model field {name!r}. Use the version "
            "that the recording was made with; its metadata names it."
        )
    if not is_settable(name):
        raise InvalidArgument(
            f"The model field {name} is part of what the model consists of, and is not "
            "set from a recording."
        )


def _check_index(model: mujoco.MjModel, name: str, value: NDArray[Any]) -> None:
    size = getattr(model, _INDICES[name])
    if value.size and (value.min() < -1 or value.max() >= size):
        raise InvalidArgument(
            f"The model field {name} holds indices from -1 to {size - 1} in this "
            f"model, and the recorded one has some from {value.min()} to {value.max()}."
        )


def _set(struct: object, name: str, value: NDArray[Any], *, field: str) -> None:
    *parts, last = name.split(".")
    holder = struct
    for part in parts:
        holder = getattr(holder, part)
    present = getattr(holder, last)
    value = np.asarray(value)
    is_whole = np.asarray(present).dtype.kind in "iub"
    if (
        np.shape(present) != value.shape
        or value.dtype.kind not in "iufb"
        # NaN would pass for any index.
        or (is_whole and not (np.floor(value) == value).all())
    ):
        raise InvalidArgument(
            f"The model field {field} is {'whole ' * is_whole}numbers of the shape "
            f"{np.shape(present)} here, and the recorded one is {value.dtype} of the "
            f"shape {value.shape}: it belongs to another model."
        )
    if name in _INDICES:
        _check_index(struct, name, value)
    if isinstance(present, np.ndarray):
        present[...] = value
        return
    try:
        setattr(holder, last, type(present)(value.item()))
    except (TypeError, OverflowError) as error:
        raise InvalidArgument(
            f"The model field {field} cannot be {value.item()}."
        ) from error

# SPDX-License-Identifier: Apache-2.0
"""The fields of a model and of a view, by name: read, set and compared.

Names are those of `MjModel`'s arrays (`geom_rgba`) and of the members of its structs
(`opt.gravity`, `vis.headlight.ambient`); of a view `camera.lookat`, `option.flags` ...
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument

VIEW_PREFIXES = ("camera.", "option.")


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
        for struct in ("opt", "vis", "stat")
        for name in member_names(getattr(model, struct))
    )


@functools.cache
def empty_model() -> mujoco.MjModel:
    """Return a model with nothing in it, which is not to be changed."""
    return mujoco.MjModel.from_xml_string("<mujoco/>")


def member_names(struct: object) -> Iterator[str]:
    """Yield the names of a struct's members that hold numbers.

    Members of structs inside it get a name with dots. An array without elements is
    none that could be read or set, and is left out.
    """
    for name in dir(struct):
        if name.startswith("_"):
            continue
        value = getattr(struct, name)
        if isinstance(value, np.ndarray):
            if value.size:
                yield name
        elif isinstance(value, int | float):
            yield name
        elif type(value).__module__.startswith("mujoco") and not callable(value):
            yield from (f"{name}.{inner}" for inner in member_names(value))


def holder_of(struct: Any, name: str) -> tuple[Any, str]:
    """Return what has a member whose name may have dots, and its last name."""
    *parts, last = name.split(".")
    return functools.reduce(getattr, parts, struct), last


def read_member(struct: object, name: str) -> NDArray[Any]:
    """Return a copy of a member of `struct`, whose name may have dots."""
    return np.array(getattr(*holder_of(struct, name)))


def read_fields(
    model: mujoco.MjModel, names: Iterable[str], **view: Any
) -> dict[str, NDArray[Any]]:
    """Return copies of fields; single numbers as arrays of no dimension.

    Args:
        model: the model.
        names: of its fields, or those that begin with `camera.` and `option.`.
        view: the `camera` and the `option`.
    """
    values = {}
    for name in names:
        struct, _, member = name.partition(".")
        holder, own = (view[struct], member) if struct in view else (model, name)
        values[name] = read_member(holder, own)
    return values


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
        fields: values by names.
        camera: what names that begin with `camera.` are set in; without it they are
            left out.
        option: likewise for `option.`.

    Raises:
        InvalidArgument: there is no such field, it has another shape, or it is none
            that `is_settable`. Fields before it have been set then.
    """
    view = {"camera": camera, "option": option}
    for name, value in fields.items():
        _check_name(name)
        struct, _, member = name.partition(".")
        if struct not in view:
            _set(model, name, value, field=name)
        elif view[struct] is not None:
            _set(view[struct], member, value, field=name)


def is_settable(name: str) -> bool:
    """Return whether a field of a model may be set to what a file says.

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

# The visualiser looks these up in tables of its own, without a look at their bounds.
_KINDS = {
    "option.label": int(mujoco.mjtLabel.mjNLABEL),
    "option.frame": int(mujoco.mjtFrame.mjNFRAME),
}

# Where a model's files were when it was compiled, and a checksum that nothing here
# depends on.
_PLACES = re.compile(r"paths|npaths|nbuffer|signature|\w+_(path|contenttype)adr")


def differing_fields(
    model: mujoco.MjModel, other: mujoco.MjModel
) -> dict[str, NDArray[Any]]:
    """Return the fields of `other` that are not as in `model`, for `apply_fields`.

    Environments set fields of a model after they compiled it: the size of the frame
    buffer, the position of a target. Where the files of the models are, is not looked
    at.

    Raises:
        ValueError: the models consist of different things, so that no setting of
            fields makes one of the other.
    """
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        is_checked = isinstance(value, (int, bytes)) and not _PLACES.fullmatch(name)
        if is_checked and value != getattr(other, name):
            raise ValueError(f"{name} differs")
    names = [n for n in (*array_names(), *struct_names()) if not _PLACES.fullmatch(n)]
    ours, theirs = read_fields(model, names), read_fields(other, names)
    # By their bytes: NaN is the same as NaN.
    changed = {n: theirs[n] for n in names if ours[n].tobytes() != theirs[n].tobytes()}
    fixed = [name for name in changed if not is_settable(name)]
    if fixed:
        raise ValueError(f"{', '.join(fixed)} differ, which only compiling can set")
    return changed


@functools.cache
def _all_names() -> frozenset[str]:
    view = {"camera": mujoco.MjvCamera(), "option": mujoco.MjvOption()}
    names = (f"{k}.{name}" for k, v in view.items() for name in member_names(v))
    return frozenset((*array_names(), *struct_names(), *names))


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


def _set(struct: Any, name: str, value: NDArray[Any], *, field: str) -> None:
    holder, last = holder_of(struct, name)
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
        size = getattr(struct, _INDICES[name])
        if value.size and (value.min() < -1 or value.max() >= size):
            raise InvalidArgument(
                f"The model field {name} holds indices from -1 to {size - 1} in this "
                f"model, and the recorded one has some from {value.min()} to "
                f"{value.max()}."
            )
    if field in _KINDS and value.item() not in range(_KINDS[field]):
        raise InvalidArgument(
            f"The field {field} has to be from 0 to {_KINDS[field] - 1} in MuJoCo "
            f"{mujoco.__version__}, got {value}."
        )
    if isinstance(present, np.ndarray):
        present[...] = value
        return
    try:
        setattr(holder, last, type(present)(value.item()))
    except (TypeError, OverflowError) as error:
        raise InvalidArgument(
            f"The model field {field} cannot be {value.item()}."
        ) from error

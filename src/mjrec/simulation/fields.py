# SPDX-License-Identifier: Apache-2.0
"""Functions that read, set and compare the fields of a model and a view by name.

The names are those of `MjModel`'s arrays (`geom_rgba`) and of the members of its
structs (`opt.gravity`, `vis.headlight.ambient`); a view's fields are `camera.lookat`,
`option.flags` and so on.
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
    """Return the names of all arrays of `MjModel` in this version of MuJoCo."""
    model = empty_model()
    names = (name for name in dir(model) if not name.startswith("_"))
    return tuple(n for n in names if isinstance(getattr(model, n), np.ndarray))


@functools.cache
def struct_names() -> tuple[str, ...]:
    """Return the names of all members of `opt`, `vis` and `stat`, with these prefixes.

    Members that the bindings cannot read (`vis.rgba.bv`) are left out.
    """
    model = empty_model()
    return tuple(
        f"{struct}.{name}"
        for struct in ("opt", "vis", "stat")
        for name in member_names(getattr(model, struct))
    )


@functools.cache
def empty_model() -> mujoco.MjModel:
    """Return an empty model. Do not modify it."""
    return mujoco.MjModel.from_xml_string("<mujoco/>")


def member_names(struct: object) -> Iterator[str]:
    """Yield the names of a struct's numeric members.

    Members of nested structs have dotted names. Empty arrays cannot be read or set and
    are left out.
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
    """Return the object that has the member, and the last part of the dotted name."""
    *parts, last = name.split(".")
    return functools.reduce(getattr, parts, struct), last


def read_member(struct: object, name: str) -> NDArray[Any]:
    """Return a copy of a member of `struct`, which may have a dotted name."""
    return np.array(getattr(*holder_of(struct, name)))


def read_fields(
    model: mujoco.MjModel, names: Iterable[str], **view: Any
) -> dict[str, NDArray[Any]]:
    """Return copies of fields; single numbers become zero-dimensional arrays.

    Args:
        model: the model.
        names: names of the model's fields, or names that begin with `camera.` or
            `option.`.
        **view: the view's `camera` and `option`.
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
    """Set fields of a model and of a view.

    Args:
        model: the model to change.
        fields: values by name.
        camera: the camera to set fields that begin with `camera.` in; if None, these
            fields are skipped.
        option: the option to set fields that begin with `option.` in; if None, these
            fields are skipped.

    Raises:
        InvalidArgument: a field does not exist, its value has the wrong shape, type or
            range, or it may not be set (see `is_settable`). Any fields before it have
            been set.
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
    """Return whether a model's field may be set to a value from a file.

    MuJoCo trusts types, addresses and most indices in a model, so a wrong value makes
    it read out of bounds. Floating-point numbers, flags, texture data and indices that
    can be checked are settable.
    """
    if "." in name or name in _INDICES or _INTEGERS.fullmatch(name):
        return True
    return getattr(empty_model(), name).dtype in _HARMLESS_TYPES


_HARMLESS_TYPES = ("<f4", "<f8", "|u1", "|b1")
_INTEGERS = re.compile(r"\w+_(contype|conaffinity|group|condim|priority)")

# Index fields, each with the model size that limits its values; -1 means no index.
_INDICES = {
    **dict.fromkeys(
        ("geom_matid", "site_matid", "skin_matid", "flex_matid", "tendon_matid"), "nmat"
    ),
    "mat_texid": "ntex",
    "light_texid": "ntex",
}

# The visualizer uses these as indices into its own tables without checking bounds.
_KINDS = {
    "option.label": int(mujoco.mjtLabel.mjNLABEL),
    "option.frame": int(mujoco.mjtFrame.mjNFRAME),
}

# The locations of a model's files at compile time, and a checksum that does not matter
# here.
_PLACES = re.compile(r"paths|npaths|nbuffer|signature|\w+_(path|contenttype)adr")


def differing_fields(
    model: mujoco.MjModel, other: mujoco.MjModel
) -> dict[str, NDArray[Any]]:
    """Return the fields in which `other` differs from `model`, for `apply_fields`.

    Environments set some fields of a model after compiling it, such as the size of the
    frame buffer or the position of a target. The locations of the models' files are not
    compared.

    Raises:
        ValueError: the models are structurally different, so that setting fields cannot
            turn one into the other.
    """
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        is_checked = isinstance(value, (int, bytes)) and not _PLACES.fullmatch(name)
        if is_checked and value != getattr(other, name):
            raise ValueError(f"{name} differs")
    names = [n for n in (*array_names(), *struct_names()) if not _PLACES.fullmatch(n)]
    ours, theirs = read_fields(model, names), read_fields(other, names)
    # Compared as bytes, because NaN must equal NaN.
    changed = {n: theirs[n] for n in names if ours[n].tobytes() != theirs[n].tobytes()}
    fixed = [name for name in changed if not is_settable(name)]
    if fixed:
        raise ValueError(f"{', '.join(fixed)} differ, and only compiling changes them")
    return changed


@functools.cache
def _all_names() -> frozenset[str]:
    view = {"camera": mujoco.MjvCamera(), "option": mujoco.MjvOption()}
    names = (f"{k}.{name}" for k, v in view.items() for name in member_names(v))
    return frozenset((*array_names(), *struct_names(), *names))


def _check_name(name: str) -> None:
    # Names may come from a file, so only known names are ever looked up or set.
    if name not in _all_names():
        raise InvalidArgument(
            f"MuJoCo {mujoco.__version__} has no model field {name!r}. Use the version "
            "that the recording was made with; see its metadata."
        )
    if not is_settable(name):
        raise InvalidArgument(
            f"The model field {name} is part of the model's structure, so it cannot be "
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
        # NaN would pass the check of an index.
        or (is_whole and not (np.floor(value) == value).all())
    ):
        raise InvalidArgument(
            f"The model field {field} must hold {'whole ' * is_whole}numbers of shape "
            f"{np.shape(present)} here, but the recorded value is {value.dtype} of "
            f"shape {value.shape}: it belongs to another model."
        )
    if name in _INDICES:
        size = getattr(struct, _INDICES[name])
        if value.size and (value.min() < -1 or value.max() >= size):
            raise InvalidArgument(
                f"The model field {name} must contain indices from -1 to {size - 1} "
                f"for this model, but the recorded indices range from {value.min()} to "
                f"{value.max()}."
            )
    if field in _KINDS and value.item() not in range(_KINDS[field]):
        raise InvalidArgument(
            f"The field {field} must be between 0 and {_KINDS[field] - 1} in MuJoCo "
            f"{mujoco.__version__}, but it is {value}."
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

# SPDX-License-Identifier: Apache-2.0
"""The fields in which two models of the same making differ.

Environments set fields of a model after they compiled it: the size of the buffer for
pictures, the position of a target.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["differing_fields", "set_fields"]

# Where a model's files were when it was compiled, and a checksum that nothing here
# depends on.
_PLACES = re.compile(r"paths|npaths|nbuffer|signature|\w+_(path|contenttype)adr")

# Beside floating-point numbers. Other whole numbers are sizes, types and indices into
# other arrays: MuJoCo trusts them, so that none is ever taken from a file.
_SETTABLE = re.compile(
    r"tex_data|light_active|\w+_(contype|conaffinity|group)|(opt|vis|stat)\..+"
)


def differing_fields(
    model: mujoco.MjModel, other: mujoco.MjModel
) -> dict[str, NDArray[Any]]:
    """Return the fields of `other` that are not as in `model`.

    Where the files of the models are, is not looked at.

    Returns:
        What `set_fields` takes: arrays by their names, and members of structs as
        `opt.gravity`, `vis.global.offwidth`.

    Raises:
        ValueError: the models consist of different things.
    """
    ours, theirs = dict(_fields(model)), dict(_fields(other))
    changed = {}
    for name, value in theirs.items():
        if not _is_same(ours[name], value):
            _check_settable(name, ours[name], value)
            changed[name] = np.array(value)
    return changed


def set_fields(model: mujoco.MjModel, fields: Mapping[str, NDArray[Any]]) -> None:
    """Set fields of a model; none of them where one cannot be set.

    Raises:
        ValueError: this model has no such field, or of another shape, or it is one
            that only compiling can set.
    """
    own = dict(_fields(model))
    for name, value in fields.items():
        if name not in own:
            raise ValueError(f"MuJoCo {mujoco.__version__} has no field {name}")
        _check_settable(name, own[name], value)
    for name, value in fields.items():
        *structs, member = _python_names(name)
        holder = model
        for struct in structs:
            holder = getattr(holder, struct)
        if isinstance(getattr(holder, member), np.ndarray):
            getattr(holder, member)[...] = value
        else:
            setattr(holder, member, value.item())


def _fields(model: mujoco.MjModel) -> Iterator[tuple[str, Any]]:
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        is_field = isinstance(value, (int, float, bytes, np.ndarray))
        if is_field and not _PLACES.fullmatch(name):
            yield name, value
    for struct in ("opt", "stat"):
        yield from _members(struct, getattr(model, struct))
    for name in ("global_", "headlight", "map", "quality", "rgba", "scale"):
        struct = f"vis.{name.rstrip('_')}"
        yield from _members(struct, getattr(model.vis, name))


def _members(struct: str, holder: object) -> Iterator[tuple[str, Any]]:
    for name in dir(holder):
        if not name.startswith("_"):
            yield f"{struct}.{name}", getattr(holder, name)


def _python_names(name: str) -> list[str]:
    # `global` is a word of the language.
    return ["global_" if part == "global" else part for part in name.split(".")]


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, bytes):
        return bool(one == other)
    first, second = np.asarray(one), np.asarray(other)
    # By their bytes: NaN is the same as NaN.
    return first.shape == second.shape and first.tobytes() == second.tobytes()


def _check_settable(name: str, own: Any, value: Any) -> None:
    if isinstance(own, bytes) or np.shape(own) != np.shape(value):
        raise ValueError(f"{name} is of another size")
    kind = np.asarray(own).dtype
    if not (kind.kind == "f" or _SETTABLE.fullmatch(name)):
        raise ValueError(f"{name} differs, which only compiling can set")
    if not np.can_cast(np.asarray(value).dtype, kind, "same_kind"):
        raise ValueError(f"{name} is of another kind")

# SPDX-License-Identifier: Apache-2.0
"""The fields in which two models of the same making differ.

Environments set fields of a model after they compiled it: the size of the buffer for
pictures, the position of a target.
"""

from __future__ import annotations

import re
from typing import Any

import mujoco
from numpy.typing import NDArray

from .model_fields import array_names, is_settable, read_fields, struct_names

# Where a model's files were when it was compiled, and a checksum that nothing here
# depends on.
_PLACES = re.compile(r"paths|npaths|nbuffer|signature|\w+_(path|contenttype)adr")


def differing_fields(
    model: mujoco.MjModel, other: mujoco.MjModel
) -> dict[str, NDArray[Any]]:
    """Return the fields of `other` that are not as in `model`.

    Where the files of the models are, is not looked at.

    Returns:
        What `model_fields.apply_fields` takes.

    Raises:
        ValueError: the models consist of different things, so that no setting of
            fields makes one of the other.
    """
    _check_sizes_and_names(model, other)
    names = [n for n in (*array_names(), *struct_names()) if not _PLACES.fullmatch(n)]
    ours, theirs = read_fields(model, names), read_fields(other, names)
    changed = {n: theirs[n] for n in names if not _is_same(ours[n], theirs[n])}
    fixed = [name for name in changed if not is_settable(name)]
    if fixed:
        raise ValueError(f"{', '.join(fixed)} differ, which only compiling can set")
    return changed


def _check_sizes_and_names(model: mujoco.MjModel, other: mujoco.MjModel) -> None:
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        is_checked = isinstance(value, (int, bytes)) and not _PLACES.fullmatch(name)
        if is_checked and value != getattr(other, name):
            raise ValueError(f"{name} differs")


def _is_same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    # By their bytes: NaN is the same as NaN.
    return one.shape == other.shape and one.tobytes() == other.tobytes()

# SPDX-License-Identifier: Apache-2.0
"""Compiled models, taken from sources, changed, and compared."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .authored_model import with_embedded_files
from .model_differences import differing_fields
from .model_fields import apply_fields, array_names, read_fields, struct_names
from .model_store import load_model

_SMOOTH = ("PLANE", "SPHERE", "CAPSULE")


def model_from_sources(directory: Path, name: str, size: Any) -> mujoco.MjModel:
    """Return the model that a recording's zip compiles to, in a process of its own.

    Args:
        directory: of the recording.
        name: of the zip in it.
        size: the recorded size of the compiled model.

    Raises:
        UnreadableFile: the zip is missing, damaged, dangerous or refused.
    """
    # Without the compiled model's name: that is never loaded.
    return load_model(directory, {"xml": name, "bytes": size})


def are_same_models(model: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Tell, in a fraction of the time of a hash, whether two models are the same."""
    return _saved(model).tobytes() == _saved(other).tobytes()


def model_digest(model: mujoco.MjModel) -> str:
    """Return the sha256 of a model as `mj_saveModel` writes it, as recordings say."""
    return hashlib.sha256(_saved(model).data).hexdigest()


def _saved(model: mujoco.MjModel) -> NDArray[np.uint8]:
    whole = with_embedded_files(model)
    buffer = np.empty(mujoco.mj_sizeModel(whole), np.uint8)
    mujoco.mj_saveModel(whole, None, buffer)
    return buffer


def keeps_paths(model: mujoco.MjModel) -> bool:
    """Tell whether a model holds the places of files, on which its hash depends."""
    names = (name for name in array_names() if name.endswith("_pathadr"))
    return any((getattr(model, name) >= 0).any() for name in names)


def has_jumping_contacts(model: mujoco.MjModel) -> bool:
    """Tell whether anything can touch whose contacts do not move smoothly.

    Those of spheres, capsules and planes do; others are found by iterating, or choose
    among corners.
    """
    smooth = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in _SMOOTH]
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return bool((~np.isin(model.geom_type, smooth) & touching).any())


def turns_by_rk4(model: mujoco.MjModel) -> bool:
    """Tell whether quaternions are integrated by the method of Runge and Kutta."""
    kinds = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    by_rk4 = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    return bool(by_rk4 and np.isin(model.jnt_type, [int(k) for k in kinds]).any())


def changed_model(
    model: mujoco.MjModel, changes: Mapping[str, NDArray[Any]]
) -> mujoco.MjModel:
    """Return a copy of a model with other values in some fields.

    Raises:
        InvalidArgument: it has no such fields.
    """
    changed = copy.copy(model)
    apply_fields(changed, changes)
    return changed


def changed_names(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """Return the names of the fields in which two models differ.

    Raises:
        ValueError: they consist of different things.
    """
    return list(differing_fields(model, other))


def differing_from(
    model: mujoco.MjModel, fields: Mapping[str, NDArray[Any]]
) -> list[str]:
    """Return the names of those fields of which a model has another value, or none.

    What is of the view and not of the model is left out.
    """
    own = [n for n in fields if not n.startswith(("camera.", "option."))]
    known = {*array_names(), *struct_names()}
    differing = []
    for name in own:
        # Names come from a file: nothing else is looked up.
        if name not in known or not _is_same(read_fields(model, [name]), fields, name):
            differing.append(name)
    return differing


def _is_same(
    present: Mapping[str, NDArray[Any]], fields: Mapping[str, NDArray[Any]], name: str
) -> bool:
    ours, theirs = present[name], np.asarray(fields[name])
    return bool(ours.shape == theirs.shape and np.array_equal(ours, theirs))

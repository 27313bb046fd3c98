# SPDX-License-Identifier: Apache-2.0
"""Why a dm_control environment could not be made, and what to do."""

from __future__ import annotations

import importlib.metadata
import re

from ..errors import EnvironmentNotMade, Error, MissingDependency


def dm_control_failure(name: str, error: Exception) -> Error:
    """Return the error for what importing dm_control, or loading a task, raised.

    Args:
        name: of the environment.
        error: what was raised.
    """
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing in ("dm_control", "dm_env"):
        return MissingDependency(
            "dm_control", purpose=name, install='pip install "mjrec[dm-control]"'
        )
    # dm_control 1.0.50 reads fields of MuJoCo's structures that mujoco 4 lacks.
    if re.search(r"Mj(Model|Data)\b.* has no attribute", str(error)):
        dm_control, mujoco = map(importlib.metadata.version, ("dm-control", "mujoco"))
        return MissingDependency(
            "a mujoco that it knows (below version 4)",
            purpose=f"{name}: dm_control {dm_control} does not work with mujoco "
            f"{mujoco} ({error}) and",
            install='pip install "mujoco<4"',
        )
    return EnvironmentNotMade(name, f"{type(error).__name__}: {error}")

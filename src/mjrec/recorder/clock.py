# SPDX-License-Identifier: Apache-2.0
"""How much simulated time lies between two frames.

The control step is measured: the difference of the simulation's time over one outer
step. That is right above action-repeat wrappers too, where every constant that the
environment declares is not. Nothing here imports a framework; it looks for what
Gymnasium's and dm_control's environments have.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

from ..rates import rate_from_timestep, to_rate

__all__ = ["declared_rate", "simulation_time"]

logger = logging.getLogger(__name__)

_DEFAULT_RATE = Fraction(30)

# Gymnasium-Robotics' mazes and kitchen hold the simulated environment in these.
_HOLDERS = ("physics", "point_env", "ant_env", "robot_env")


def simulation_time(env: object) -> float | None:
    """Return the time of the MuJoCo simulation inside `env`, in seconds.

    None where there is no simulation that mjrec can see.
    """
    for holder in _simulations(env):
        time = getattr(getattr(holder, "data", None), "time", None)
        if isinstance(time, float):
            return time
    return None


def declared_rate(env: object) -> Fraction:
    """Return the frames per second that an environment says it has.

    The control timestep of a dm_control environment, `dt` of a MuJoCo environment of
    Gymnasium, else `render_fps` of the metadata; 30, with a warning, where nothing is
    said.
    """
    timestep = _declared_timestep(env)
    if timestep:
        return rate_from_timestep(timestep)
    metadata = getattr(env, "metadata", None) or {}
    fps = metadata.get("render_fps")
    if fps:
        return to_rate(fps)
    logger.warning(
        "%s does not say how fast its videos are to play (no control timestep, no "
        "render_fps): %d frames a second are taken. Give fps= to choose.",
        type(env).__name__,
        _DEFAULT_RATE,
    )
    return _DEFAULT_RATE


def _declared_timestep(env: object) -> float | None:
    control_timestep = getattr(env, "control_timestep", None)
    if callable(control_timestep):
        return float(control_timestep())
    if simulation_time(env) is None:
        return None
    dt = getattr(getattr(env, "unwrapped", env), "dt", None)
    return float(dt) if dt else None


def _simulations(env: object) -> Iterator[Any]:
    base = getattr(env, "unwrapped", env)
    yield base
    for name in _HOLDERS:
        holder = getattr(base, name, None)
        if holder is not None:
            yield holder

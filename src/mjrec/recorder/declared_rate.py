# SPDX-License-Identifier: Apache-2.0
"""The frame rate that an environment says it has.

It is taken only where the rate cannot be measured: the difference of the simulation's
time over one outer step is right above action-repeat wrappers too, where every
constant that the environment declares is not.
"""

from __future__ import annotations

import logging
from fractions import Fraction
from typing import Any

from ..errors import InvalidArgument
from ..rates import rate_from_timestep, to_rate
from ..simulation.inside import simulation_in

logger = logging.getLogger(__name__)

_DEFAULT_RATE = Fraction(30)


def declared_rate(env: object) -> Fraction:
    """Return the frames per second that an environment says it has.

    The control timestep of a dm_control environment, `dt` of a MuJoCo environment of
    Gymnasium, else `render_fps` of the metadata; 30, with a warning, where nothing is
    said.

    Raises:
        InvalidArgument: `render_fps` is no rate.
    """
    timestep = _declared_timestep(env)
    if timestep:
        return rate_from_timestep(timestep)
    fps = (getattr(env, "metadata", None) or {}).get("render_fps")
    if fps is not None:
        return _checked(fps, env)
    logger.warning(
        "%s does not say how fast its videos are to play (no control timestep, no "
        "render_fps): %d frames a second are taken. Give fps= to choose.",
        type(env).__name__,
        _DEFAULT_RATE,
    )
    return _DEFAULT_RATE


def _checked(fps: Any, env: object) -> Fraction:
    try:
        return to_rate(fps)
    except InvalidArgument as error:
        raise InvalidArgument(
            f'metadata["render_fps"] of {type(env).__name__} is no rate: {error} '
            "Give fps= to choose another."
        ) from error


def _declared_timestep(env: object) -> float | None:
    base = getattr(env, "unwrapped", env)
    control_timestep = getattr(base, "control_timestep", None)
    if callable(control_timestep):
        return float(control_timestep())
    if simulation_in(env) is None:
        return None
    dt = getattr(base, "dt", None)
    return float(dt) if dt else None

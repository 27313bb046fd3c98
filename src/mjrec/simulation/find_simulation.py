# SPDX-License-Identifier: Apache-2.0
"""Functions that find the MuJoCo simulation inside an environment, by duck typing.

They import nothing, because MuJoCo chooses its OpenGL backend on import and must not be
loaded for an environment without a simulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

# Attributes that may hold the simulation if the environment itself does not:
# dm_control's physics, and the environments in Gymnasium-Robotics' mazes and kitchen.
_HOLDERS = ("physics", "point_env", "ant_env", "robot_env")


def simulation_in(env: object) -> Any:
    """Return the object that has MuJoCo's `model` and `data` as attributes.

    Both attributes are MuJoCo's own objects or dm_control's wrappers around them.

    Args:
        env: a Gymnasium or dm_env environment, wrapped or not.

    Returns:
        The object, or None if no simulation can be found.
    """
    base = getattr(env, "unwrapped", env)
    for holder in _holders(base):
        if _is_mujocos(holder, "model") and _is_mujocos(holder, "data"):
            return holder
    return None


def _holders(base: object) -> Iterator[object]:
    yield base
    for name in _HOLDERS:
        yield getattr(base, name, None)


def simulation_time(env: object) -> float | None:
    """Return the simulation time in seconds, or None if there is no simulation."""
    simulation = simulation_in(env)
    return None if simulation is None else float(simulation.data.time)


def _is_mujocos(holder: object, name: str) -> bool:
    # dm_control's wrappers hold the MjModel or MjData as `ptr`.
    value = getattr(holder, name, None)
    return type(getattr(value, "ptr", value)).__name__ == f"Mj{name.capitalize()}"

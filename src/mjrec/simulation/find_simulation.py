# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo simulation inside an environment, found by its shape.

Nothing is imported: an environment that has no simulation must not load MuJoCo, which
settles its OpenGL backend when it is imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

# Where the simulated part is, if it is not the environment itself: dm_control's
# physics, and the environments inside Gymnasium-Robotics' mazes and kitchen.
_HOLDERS = ("physics", "point_env", "ant_env", "robot_env")


def simulation_in(env: object) -> Any:
    """Return the object that has MuJoCo's `model` and `data` as attributes.

    They are MuJoCo's own, or dm_control's wrappers of them.

    Args:
        env: a Gymnasium or dm_env environment, wrapped or not.

    Returns:
        None where there is no simulation that can be seen.
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
    """Return the time of the simulation inside `env`, in seconds; None without one."""
    simulation = simulation_in(env)
    return None if simulation is None else float(simulation.data.time)


def _is_mujocos(holder: object, name: str) -> bool:
    # MjModel and MjData, in dm_control's wrappers as `ptr`.
    value = getattr(holder, name, None)
    return type(getattr(value, "ptr", value)).__name__ == f"Mj{name.capitalize()}"

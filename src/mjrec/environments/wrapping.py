# SPDX-License-Identifier: Apache-2.0
"""What stands between a monitor and the environment that it records.

An action that was recorded above a wrapper need not be what the environment got, so
recreating the environment takes its wrappers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from .scenes import class_name, plain_arguments

# They hand actions, rewards and the ends of episodes on as they are. `TimeLimit` does
# not, and is told apart, by its number.
_TRANSPARENT = frozenset(
    {
        "gymnasium.wrappers.common.OrderEnforcing",
        "gymnasium.wrappers.common.PassiveEnvChecker",
        "gymnasium.wrappers.common.RecordEpisodeStatistics",
        "gymnasium.wrappers.common.TimeLimit",
        "gymnasium.wrappers.rendering.RecordVideo",
        "mjrec.monitors.dm_env_monitor.DmEnvMonitor",
        "mjrec.monitors.gymnasium_monitor.GymnasiumMonitor",
    }
)
# Where dm_env's wrappers, and dm_control's, keep what they wrap.
_INSIDE = ("_env", "_environment", "environment")


def around_gymnasium(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return what is around the innermost environment.

    Args:
        env: as the user wrapped it.

    Returns:
        `wrappers`, the full names of the classes of wrappers, outermost first, that may
        change what goes through them, where there are any the `wrapper_arguments` of
        each, and `max_episode_steps`, the least limit of a `TimeLimit`, or None.
    """
    layers: list[Any] = []
    while isinstance(env, gymnasium.Wrapper):
        layers.append(env)
        env = env.env
    facts = _facts(layers, (getattr(e, "_max_episode_steps", None) for e in layers))
    if facts["wrappers"]:
        facts["wrapper_arguments"] = list(map(_arguments_of, _changing(layers)))
    return facts


def around_dm_env(env: Any) -> dict[str, Any]:
    """Return the same of a dm_env environment; limits are dm_control's own.

    What a wrapper keeps under a name of its own is not found, and then the wrapper
    counts as the environment; `wrappers` names it all the same, because it is none of
    dm_control's environments.
    """
    layers: list[Any] = []
    while not _is_innermost(env):
        layers.append(env)
        inside = (_own(env, name) for name in _INSIDE)
        env = next((each for each in inside if each is not None), None)
        if env is None:
            break
    return _facts(layers, (_own(each, "_step_limit") for each in [*layers, env]))


def _facts(layers: list[Any], limits: Iterable[Any]) -> dict[str, Any]:
    known = [int(limit) for limit in limits if _is_limit(limit)]
    return {
        "wrappers": [class_name(type(layer)) for layer in _changing(layers)],
        "max_episode_steps": min(known, default=None),
    }


def _changing(layers: Iterable[Any]) -> list[Any]:
    return [layer for layer in layers if class_name(type(layer)) not in _TRANSPARENT]


def _arguments_of(wrapper: Any) -> dict[str, Any] | None:
    """Return what a wrapper of Gymnasium's was made with; None where it keeps it not.

    None also where an argument is more than JSON can hold, a function for instance.
    """
    saved = getattr(wrapper, "_saved_kwargs", None)
    if not isinstance(wrapper, RecordConstructorArgs) or saved is None:
        return None
    return plain_arguments(saved)


def _is_limit(limit: Any) -> bool:
    return isinstance(limit, int | float) and math.isfinite(limit)


def _is_innermost(env: Any) -> bool:
    return class_name(type(env)) in (
        "dm_control.rl.control.Environment",
        "dm_control.composer.environment.Environment",
    )


def _own(env: Any, name: str) -> Any:
    """Return an attribute that an object has, without asking what it wraps.

    Not by its `__dict__`, for the reason that `has_own_method` gives.
    """
    try:
        return object.__getattribute__(env, name)
    except AttributeError:
        return None

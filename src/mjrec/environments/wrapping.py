# SPDX-License-Identifier: Apache-2.0
"""The wrappers between a monitor and the environment that it records.

An action recorded above a wrapper may differ from the action that the environment
received, so recreating the environment includes recreating its wrappers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from .scenes import class_name, plain_arguments

# Wrappers that pass on actions, rewards and episode ends unchanged. `TimeLimit` does
# not, but it is recorded separately, as a number.
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
# Attributes in which dm_env's and dm_control's wrappers keep the inner environment.
_INSIDE = ("_env", "_environment", "environment")


def around_gymnasium(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the wrappers and the step limit around the innermost environment.

    Args:
        env: the environment, as the user wrapped it.

    Returns:
        `wrappers`, the full class names of the wrappers that may change actions,
        rewards or episode ends, outermost first; `wrapper_arguments`, the arguments of
        each wrapper, if there are any wrappers; and `max_episode_steps`, the lowest
        limit of a `TimeLimit`, or None.
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
    """Return the same facts about a dm_env environment. Limits are dm_control's own.

    An inner environment is not found if the name of its attribute is unknown. In that
    case, the wrapper counts as the environment, but is still listed in `wrappers`,
    because it is not one of dm_control's environments.
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
    """Return the arguments of a Gymnasium wrapper, or None if it does not keep them.

    The result is also None if JSON cannot represent an argument, such as a function.
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
    """Return an attribute of an object itself, not one of an object that it wraps.

    The object's `__dict__` is not used, for the reason given in `has_own_method`.
    """
    try:
        return object.__getattribute__(env, name)
    except AttributeError:
        return None

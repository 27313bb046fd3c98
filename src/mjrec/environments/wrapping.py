# SPDX-License-Identifier: Apache-2.0
"""The wrappers between a monitor and the recorded environment.

A wrapper may change an action before the environment receives it, so recreating the
environment includes recreating its wrappers.

Wrappers that are not available are replaced by a `StandIn`, which steps the simulation
with the recorded controls instead of the wrapper's output for an action. If the
simulation's rewards and episode ends differ from the recorded ones, which may come from
the wrapper, the recorded values are passed on and counted. Actions that differ from the
controls are also counted, because there is no proof that they led to these controls.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from .scenes import class_name, plain_arguments

# Wrappers that pass on actions, rewards and episode ends unchanged. `TimeLimit` changes
# episode ends, but it is recorded separately, as a number.
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
_INNERMOST = (
    "dm_control.rl.control.Environment",
    "dm_control.composer.environment.Environment",
)
# Attributes in which wrappers from dm_env and dm_control keep the inner environment.
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
    """Return the same facts for a dm_env environment. Limits are dm_control's own.

    If the attribute of an inner environment has an unknown name, the wrapper counts as
    the environment. It is still listed in `wrappers`, because it is not from
    dm_control.
    """
    layers: list[Any] = []
    while class_name(type(env)) not in _INNERMOST:
        layers.append(env)
        inside = (_own(env, name) for name in _INSIDE)
        env = next((each for each in inside if each is not None), None)
        if env is None:
            break
    return _facts(layers, (_own(each, "_step_limit") for each in [*layers, env]))


def _facts(layers: list[Any], limits: Iterable[Any]) -> dict[str, Any]:
    numbers = (limit for limit in limits if isinstance(limit, int | float))
    known = [int(limit) for limit in numbers if math.isfinite(limit)]
    return {
        "wrappers": [class_name(type(layer)) for layer in _changing(layers)],
        "max_episode_steps": min(known, default=None),
    }


def _changing(layers: Iterable[Any]) -> list[Any]:
    return [layer for layer in layers if class_name(type(layer)) not in _TRANSPARENT]


def _arguments_of(wrapper: Any) -> dict[str, Any] | None:
    """Return the arguments of a Gymnasium wrapper, or None if they are unknown.

    The result is also None if JSON cannot represent an argument, such as a function.
    """
    saved = getattr(wrapper, "_saved_kwargs", None)
    if not isinstance(wrapper, RecordConstructorArgs) or saved is None:
        return None
    return plain_arguments(saved)


def _own(env: Any, name: str) -> Any:
    """Return an attribute of an object itself, not of an object that it wraps.

    The object's `__dict__` is not used, for the reason given in `has_own_method`.
    """
    try:
        return object.__getattribute__(env, name)
    except AttributeError:
        return None


@dataclass(frozen=True, kw_only=True)
class RecordedSteps:
    """The recorded steps of an episode.

    Attributes:
        controls: the controls of each step.
        rewards: the reward of each step.
        terminated: whether each step terminated the episode.
        truncated: whether each step truncated the episode.
    """

    controls: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class StandIn(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that steps an environment with recorded controls.

    Attributes:
        differing: number of this episode's steps whose recorded reward or end differs.
        translated: number of this episode's steps whose action and controls differ.
    """

    differing = translated = 0
    _steps: RecordedSteps | None = None
    _taken = 0

    def begin(self, steps: RecordedSteps) -> None:
        """Start the replay of an episode that has just been reset."""
        self._steps, self._taken = steps, 0
        self.differing = self.translated = 0

    def step(
        self, action: Any
    ) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take the next recorded step, ignoring the action."""
        steps, taken = self._steps, self._taken
        if steps is None:
            return self.env.step(action)
        self._taken += 1
        controls = steps.controls[taken]
        if not np.array_equal(np.ravel(action), np.ravel(controls)):
            self.translated += 1
        observation, *own, info = self.env.step(controls)
        recorded = (
            float(steps.rewards[taken]),
            bool(steps.terminated[taken]),
            bool(steps.truncated[taken]),
        )
        reward, terminated, truncated = own
        if (float(reward), bool(terminated), bool(truncated)) != recorded:
            self.differing += 1
        return observation, *recorded, info


def stand_ins(
    env: gymnasium.Env[Any, Any],
    names: Sequence[str],
    arguments: Sequence[Mapping[str, Any] | None],
) -> tuple[gymnasium.Env[Any, Any], StandIn]:
    """Return an environment inside a stand-in and placeholders with the given names.

    Args:
        env: the environment.
        names: class names of the wrappers, outermost first.
        arguments: the recorded arguments of each wrapper.

    Returns:
        The outermost wrapper, and the stand-in, whose `begin` must be called.
    """
    around: Any = env
    first: StandIn | None = None
    for name, given in reversed(list(zip(names, arguments, strict=True))):
        module, _, qualified = name.rpartition(".")
        bases: tuple[type, ...] = (gymnasium.Wrapper,) if first else (StandIn,)
        if given is not None:
            bases = (*bases, RecordConstructorArgs)
        # The class must have the recorded name, because names will be compared.
        around = type(qualified, bases, {"__module__": module})(around)
        if given is not None:
            around._saved_kwargs = dict(given)
        first = first or around
    assert first is not None, "there are names"
    return around, first

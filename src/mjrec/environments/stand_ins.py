# SPDX-License-Identifier: Apache-2.0
"""Substitutes for wrappers that are not available when a recording is replayed.

The simulation underneath is stepped with the recorded controls instead of the wrapper's
output for an action. If its own rewards and episode ends differ from the recorded ones,
which may come from the wrapper, the recorded values are passed on and counted. Actions
that differ from the controls are counted too, because nothing proves that the actions
led to these controls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray


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
        differing: number of steps in this episode whose recorded reward or end differs.
        translated: number of steps in it whose action differs from the controls.
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

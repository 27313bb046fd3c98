# SPDX-License-Identifier: Apache-2.0
"""What stands in for wrappers that are not here, where a recording is played again.

The simulation underneath is stepped with the recorded controls in place of what a
wrapper made of an action. Its own rewards and ends count, unless others are recorded:
those may be the wrapper's, and are handed on and counted. So are actions that are not
the controls: nothing says that they led to these.
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
    """The steps of an episode as they are recorded.

    Attributes:
        controls: of each step.
        rewards: likewise, as all of them.
        terminated: likewise.
        truncated: likewise.
    """

    controls: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class StandIn(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Steps an environment with recorded controls.

    Attributes:
        differing: of how many steps of this episode another reward or end is recorded.
        translated: in how many the action is not what was controlled.
    """

    differing = translated = 0
    _steps: RecordedSteps | None = None
    _taken = 0

    def begin(self, steps: RecordedSteps) -> None:
        """Take the recorded steps of the episode that has just begun."""
        self._steps, self._taken = steps, 0
        self.differing = self.translated = 0

    def step(
        self, action: Any
    ) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take the next recorded step, whatever the action."""
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
    """Return an environment with a stand-in around it, and others of these names.

    Args:
        env: the environment.
        names: of the classes of the wrappers, outermost first.
        arguments: of each, as a recording has them.

    Returns:
        The outermost, and the one that is to be told of the steps.
    """
    around: Any = env
    first: StandIn | None = None
    for name, given in reversed(list(zip(names, arguments, strict=True))):
        module, _, qualified = name.rpartition(".")
        bases: tuple[type, ...] = (gymnasium.Wrapper,) if first else (StandIn,)
        if given is not None:
            bases = (*bases, RecordConstructorArgs)
        # A recording says the name of its class, which is compared.
        around = type(qualified, bases, {"__module__": module})(around)
        if given is not None:
            around._saved_kwargs = dict(given)
        first = first or around
    assert first is not None, "there are names"
    return around, first

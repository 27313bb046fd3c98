# SPDX-License-Identifier: Apache-2.0
"""The end of dm_env episodes: whose end it is, and one after a number of steps."""

from __future__ import annotations

from typing import Any

import dm_env


def is_terminated(timestep: dm_env.TimeStep) -> bool:
    """Tell whether the task itself ended the episode: LAST with a discount of 0."""
    return bool(timestep.last() and not timestep.discount)


def is_truncated(timestep: dm_env.TimeStep) -> bool:
    """Tell whether a limit from outside ended the episode.

    That is LAST with another discount than 0: rewards would have followed.
    """
    return bool(timestep.last() and timestep.discount)


class StepLimit(dm_env.Environment):  # type: ignore[misc]  # untyped
    """Ends each episode of an environment after a number of steps, as truncated.

    The last step is LAST and keeps its reward, its observation and its discount; an
    episode that ends by itself before is left as it is. As in every dm_env environment
    a step before the first reset, or after LAST, begins an episode. All else that the
    environment has (`physics`, `task`, `control_timestep` ...) is here too.

    Args:
        environment: whose episodes are too long.
        max_steps: how many steps an episode has at most, at least 1.
    """

    def __init__(self, environment: dm_env.Environment, max_steps: int) -> None:
        self._environment = environment
        self._max_steps = max_steps
        self._steps = 0
        self._ended = True

    @property
    def max_steps(self) -> int:
        """How many steps an episode has at most."""
        return self._max_steps

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode."""
        self._steps = 0
        self._ended = False
        return self._environment.reset()

    def step(self, action: Any) -> dm_env.TimeStep:
        """Step the environment, or begin an episode where none is in progress."""
        if self._ended:
            return self.reset()
        timestep = self._environment.step(action)
        self._steps += 1
        if self._steps >= self._max_steps:
            timestep = timestep._replace(step_type=dm_env.StepType.LAST)
        self._ended = timestep.last()
        return timestep

    def observation_spec(self) -> Any:
        """Return the environment's."""
        return self._environment.observation_spec()

    def action_spec(self) -> Any:
        """Return the environment's."""
        return self._environment.action_spec()

    def reward_spec(self) -> Any:
        """Return the environment's."""
        return self._environment.reward_spec()

    def discount_spec(self) -> Any:
        """Return the environment's."""
        return self._environment.discount_spec()

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()

    def __getattr__(self, name: str) -> Any:
        # Called only for what is not found here; `_environment` itself is missing
        # while an object is copied.
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self._environment, name)

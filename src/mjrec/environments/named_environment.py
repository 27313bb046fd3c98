# SPDX-License-Identifier: Apache-2.0
"""An environment requested by name: its options, and how to run it."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..errors import Error, InvalidArgument
from ..frames import check_size
from .episode_seeds import EpisodeSeeds
from .scenes import Scenes

_DEFAULT_MAX_STEPS = 1000


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """Options for creating an environment.

    Attributes:
        camera: a camera's name or number; None for the model's tracking camera, if it
            has one.
        height: height of the frames in pixels; None for the environment's own.
        width: width of the frames in pixels; None for the environment's own.
        max_steps: number of steps after which an episode ends as truncated. If the
            environment has its own limit, the smaller one applies. If both are missing,
            the limit is 1000. Infinity stands for no limit.
        frames: whether the environment will be drawn.
        seed: the run's seed, for random choices made when the environment is created.
        kwargs: additional arguments, in the form that this kind of environment accepts.

    Raises:
        InvalidArgument: a value is invalid.
    """

    camera: str | int | None = None
    height: int | None = None
    width: int | None = None
    max_steps: float | None = None
    frames: bool = True
    seed: int = 0
    kwargs: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # None is valid and means the environment's own size.
        check_size(
            1 if self.height is None else self.height,
            1 if self.width is None else self.width,
        )
        steps = self.max_steps
        whole = isinstance(steps, int | np.integer) and not isinstance(steps, bool)
        if steps not in (None, np.inf) and (not whole or steps < 1):
            raise InvalidArgument(
                f"max_steps must be a positive whole number, not {steps!r}."
            )

    @property
    def size(self) -> dict[str, int]:
        """The requested `height` and `width`, excluding None."""
        sides = {"height": self.height, "width": self.width}
        return {name: side for name, side in sides.items() if side is not None}

    def limit(self, own: float | None) -> int | None:
        """Return the number of steps after which an episode ends; None for no limit.

        Args:
            own: the environment's own limit; None or infinity if it has none.
        """
        smallest = min(np.inf if own is None else own, self.max_steps or np.inf)
        if smallest == np.inf:
            return _DEFAULT_MAX_STEPS if self.max_steps is None else None
        return int(smallest)


class Step(NamedTuple):
    """The result of a step."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool


def is_terminated(timestep: Any) -> bool:
    """Return whether the task itself ended the episode (LAST with discount 0)."""
    return bool(timestep.last() and not timestep.discount)


def is_truncated(timestep: Any) -> bool:
    """Return whether an external limit ended the episode.

    In that case, the time step is LAST with a nonzero discount, because more rewards
    would have followed.
    """
    return bool(timestep.last() and timestep.discount)


class NamedEnvironment(abc.ABC):
    """A common interface for running episodes in an environment of any framework.

    In the methods, `around` is the environment or its wrapper, such as a monitor.

    Attributes:
        environment: a `gymnasium.Env` or a `dm_env.Environment`.
        env_id: the environment's name in recordings.
        step_limit: number of steps after which episodes end.
        view: the `camera`, `height` and `width` to pass to the monitor; empty if the
            environment itself shows the requested view.
        not_drawn: why the environment cannot be drawn although frames were requested.
        draws_when_made: whether the model depends on the seed used to create the
            environment.
    """

    environment: Any
    env_id: str
    step_limit: int
    view: Mapping[str, Any] = MappingProxyType({})
    not_drawn: Error | None = None
    draws_when_made = False

    def begin_episode(self, around: Any, seeds: EpisodeSeeds) -> Any:
        """Reset with an episode's seeds, and return the first observation."""
        return self.begin(around, seeds, seeds.environment)

    @abc.abstractmethod
    def begin(self, around: Any, seeds: EpisodeSeeds, seed: int | None) -> Any:
        """Reset, and return the first observation.

        Args:
            around: the environment, or a wrapper around it.
            seeds: the episode's seeds, which also seed the source of actions.
            seed: the seed for the environment's randomness from now on; None to
                continue without setting a seed.
        """

    @abc.abstractmethod
    def step(self, around: Any, action: Any) -> Step:
        """Take a step, and return its result."""

    @abc.abstractmethod
    def scenes(self) -> Scenes:
        """Return how to record the environment's states and draw its frames."""

    def can_be_deferred(self) -> bool:
        """Return whether the environment's frames can be drawn from its states."""
        scenes = self.scenes()
        return scenes.states is not None and scenes.obstacle is None

# SPDX-License-Identifier: Apache-2.0
"""An environment that was asked for by its name: how it is made, and how it is run."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..errors import Error, InvalidArgument
from ..frames import check_size
from .episode_seeds import EpisodeSeeds
from .scenes import Scenes

DEFAULT_MAX_STEPS = 1000


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """How an environment is made.

    Attributes:
        camera: a camera's name or number; None is the model's tracking camera where
            there is one.
        height: of the frames, in pixels; None is the environment's own.
        width: likewise.
        max_steps: ends an episode as truncated. Where the environment has a limit of
            its own, the smaller one wins; where it has none, None is 1000.
        frames: whether the environment will be drawn.
        seed: of the run, for what an environment draws once, when it is made.
        kwargs: more arguments, in the form that the kind of environment takes.

    Raises:
        InvalidArgument: a value that cannot be.
    """

    camera: str | int | None = None
    height: int | None = None
    width: int | None = None
    max_steps: int | None = None
    frames: bool = True
    seed: int = 0
    kwargs: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # The side that is not asked for is the environment's own, and fits.
        check_size(
            1 if self.height is None else self.height,
            1 if self.width is None else self.width,
        )
        steps = self.max_steps
        whole = isinstance(steps, int | np.integer) and not isinstance(steps, bool)
        if steps is not None and (not whole or steps < 1):
            raise InvalidArgument(
                f"max_steps must be a positive whole number, got {steps!r}."
            )

    @property
    def size(self) -> dict[str, int]:
        """The sides that are asked for, by name."""
        sides = {"height": self.height, "width": self.width}
        return {name: side for name, side in sides.items() if side is not None}

    def limit(self, own: float | None) -> int:
        """Return the number of steps after which an episode ends.

        Args:
            own: the limit that the environment has by itself; None or infinity if it
                has none.
        """
        limits = [limit for limit in (own, self.max_steps) if limit is not None]
        smallest = min(limits, default=np.inf)
        return DEFAULT_MAX_STEPS if smallest == np.inf else int(smallest)


class Step(NamedTuple):
    """What a step gave."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool


def is_terminated(timestep: Any) -> bool:
    """Return whether the task itself ended the episode: LAST with a discount of 0."""
    return bool(timestep.last() and not timestep.discount)


def is_truncated(timestep: Any) -> bool:
    """Return whether a limit from outside ended the episode.

    That is LAST with another discount than 0: rewards would have followed.
    """
    return bool(timestep.last() and timestep.discount)


class NamedEnvironment(abc.ABC):
    """An environment, and how its episodes are run whatever its framework.

    `around` is the environment, or a wrapper of it such as a monitor.

    Args:
        environment: a `gymnasium.Env` or a `dm_env.Environment`.
        env_id: its name in recordings.
        step_limit: after how many steps its episodes end.
        view: `camera`, `height` and `width` as far as the monitor is to be given them;
            empty where the environment itself shows what was asked for.
        not_drawn: why it cannot be drawn though frames were asked for.
    """

    def __init__(
        self,
        environment: Any,
        *,
        env_id: str,
        step_limit: int,
        view: Mapping[str, Any] | None = None,
        not_drawn: Error | None = None,
    ) -> None:
        self.environment = environment
        self.env_id = env_id
        self.step_limit = step_limit
        self.view = view or {}
        self.not_drawn = not_drawn

    @property
    def draws_when_made(self) -> bool:
        """Whether its model depends on the seed that it was made with."""
        return False

    def begin_episode(self, around: Any, seeds: EpisodeSeeds) -> Any:
        """Reset to an episode's seeds, and return the first observation."""
        return self.begin(around, seeds, seeds.environment)

    @abc.abstractmethod
    def begin(self, around: Any, seeds: EpisodeSeeds, seed: int | None) -> Any:
        """Reset, and return the first observation.

        Args:
            around: the environment, or a wrapper of it.
            seeds: of the episode; what draws its actions is seeded with them.
            seed: of the environment's randomness from here on; None lets it go on.
        """

    @abc.abstractmethod
    def step(self, around: Any, action: Any) -> Step:
        """Step, and return what that gave."""

    @abc.abstractmethod
    def scenes(self) -> Scenes:
        """Return what is known of its frames and its states."""

    def can_be_deferred(self) -> bool:
        """Return whether what it shows can be drawn from its states."""
        scenes = self.scenes()
        return scenes.states is not None and scenes.obstacle is None

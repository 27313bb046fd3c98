# SPDX-License-Identifier: Apache-2.0
"""The monitor for Gymnasium environments."""

from __future__ import annotations

import functools
import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..environments.gymnasium_frames import close_environment
from ..environments.gymnasium_scenes import gymnasium_scenes
from ..recorder.finishers import Finisher
from ..recorder.options import RecorderOptions
from .base import EnvironmentMonitor

logger = logging.getLogger(__name__)

_Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class GymnasiumMonitor(EnvironmentMonitor, gymnasium.Wrapper[Any, Any, Any, Any]):
    """A monitor for a Gymnasium environment. Create it with `mjrec.Monitor`.

    An episode ends when it is terminated or truncated. A reset during an episode is an
    error unless early resets are allowed. A step before the first reset or after an
    episode's end is always an error. A reset before any step keeps the episode's number
    and replaces its first frame. With Gymnasium's `Autoreset` wrapper, the step after
    an end is a reset and starts the next episode.

    After `close`, calls go straight to the closed environment, and nothing is recorded.
    """

    allows_early_reset = False

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        env_id: str | None = None,
        env_index: int | None = None,
        rendering: Callable[[Path], Finisher] | None = None,
        close_environment: Callable[[Any], None] = close_environment,
        **view: Any,
    ) -> None:
        super().__init__(env)
        # gym's convention: the step that ends an episode starts the next one.
        self._same_step_autoreset = bool(env.metadata.get("semantics.autoreset"))
        self._next_step_autoreset = _has_autoreset(env)
        self._open(
            env,
            directory,
            options,
            scenes=functools.partial(gymnasium_scenes, env),
            view=view,
            close_environment=close_environment,
            rendering=rendering,
            env_id=env_id or env_id_of(env),
            env_index=env_index,
        )

    # Gymnasium's own wrappers also override the attribute with a property.
    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The environment's own spec, which creates environments without monitors."""
        return self.env.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and start an episode.

        Raises:
            ResetNotAllowed: an episode is running and early resets are not allowed.
        """
        if self._recorder.closed:
            return self.env.reset(seed=seed, options=options)
        self._recorder.before_reset()
        result = self._reset_by(lambda: self.env.reset(seed=seed, options=options))
        self._begin(seed=seed, options=options, observation=result[0])
        return result

    def step(self, action: Any) -> _Step:
        """Step the environment and record the result.

        Raises:
            ResetNeeded: there has been no reset yet, or none since an episode ended.
        """
        recorder = self._recorder
        fast = recorder.fast
        if fast is None or not fast.before_step(action):
            if recorder.closed:
                return self.env.step(action)
            if self._before_step(action):
                result = self._reset_by(lambda: self.env.step(action))
                self._begin(observation=result[0])
                return result
        try:
            result = self.env.step(action)
        except BaseException as error:
            recorder.note_error(error)
            raise
        if fast is not recorder.fast:
            # The monitor was closed, or its process forked, during the step.
            fast = None
        _, reward, terminated, truncated, _ = result
        if fast is None or terminated or truncated or not fast.step(reward):
            self._record(*result)
        return result

    def _before_step(self, action: Any) -> bool:
        """Record an action; return whether the next step will be a reset instead."""
        if self._next_step_autoreset and self._recorder.done:
            self._recorder.before_reset()
            return True
        self._recorder.before_step(action)
        return False

    def _begin(
        self, *, seed: Any = None, options: Any = None, observation: Any = None
    ) -> None:
        self._began = time.perf_counter()
        super()._begin(seed=seed, options=options, observation=observation)

    def _record(
        self,
        observation: Any,
        reward: SupportsFloat,
        terminated: bool,
        truncated: bool,
        info: dict[str, Any],
        first_observation: Any = None,
    ) -> None:
        """Record a step, and also a reset if the step included one.

        Args:
            observation: the step's observation.
            reward: the step's reward.
            terminated: whether the step terminated the episode.
            truncated: whether the step truncated the episode.
            info: the step's info, to which `episode` may be added.
            first_observation: the first observation of the episode that the step
                starts; if None, `observation`.
        """
        if self._recorder.closed:
            return
        done = bool(terminated or truncated)
        resets_itself = self._same_step_autoreset and done
        self._recorder.step(
            reward,
            terminated=terminated,
            truncated=truncated,
            frame=not resets_itself,
            observation=observation,
            success=success_in(info) if done else None,
        )
        if done and self._options.episode_info:
            stats = self.stats_recorder
            episode = {
                "r": stats.episode_rewards[-1],
                "l": stats.episode_lengths[-1],
                "t": round(time.perf_counter() - self._began, 6),
            }
            info.setdefault("episode", episode)
        if resets_itself:
            self._recorder.before_reset()
            first = observation if first_observation is None else first_observation
            self._begin(observation=first)


def env_id_of(env: gymnasium.Env[Any, Any]) -> str:
    """Return an environment's name in its spec; `(unknown:ClassName)` without one."""
    if env.spec is not None:
        return env.spec.id
    unknown = f"(unknown:{type(env.unwrapped).__name__})"
    logger.warning(
        "The environment has no spec, so its name is unknown and the recordings say "
        "%s. Environments created with gymnasium.make have a spec.",
        unknown,
    )
    return unknown


def success_in(info: Mapping[str, Any]) -> bool | None:
    """Return whether an episode was successful; None if unknown.

    Args:
        info: the info of the episode's last step. `is_success` is used or, without it,
            `success`: a bool, a number, or an array that contains one of these.
    """
    # Gymnasium-Robotics' Fetch and Hand environments use the first key; its Adroit and
    # maze environments, MetaWorld and others use the second.
    for key in ("is_success", "success"):
        value = info.get(key)
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.item()
        if isinstance(value, bool | int | float | np.bool_ | np.number):
            return bool(value)
    return None


def _has_autoreset(env: gymnasium.Env[Any, Any]) -> bool:
    # This attribute is set for sub-environments in other processes.
    if getattr(env, "resets_in_next_step", False):
        return True
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.Autoreset):
            return True
        env = env.env
    return False

# SPDX-License-Identifier: Apache-2.0
"""The monitor of Gymnasium environments."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..environments.gymnasium_frames import close_environment, gymnasium_frames
from ..environments.gymnasium_scenes import gymnasium_scenes, own_camera
from ..recorder.finishers import Finisher
from ..recorder.options import RecorderOptions
from .base import NO_SIMULATION, EnvironmentMonitor
from .cameras import camera_frames, recorded_view

logger = logging.getLogger(__name__)

_Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class GymnasiumMonitor(EnvironmentMonitor, gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records a Gymnasium environment; made by `mjrec.Monitor`, which has the options.

    An episode ends when it is terminated or truncated. A reset in the middle of an
    episode is an error unless early resets are allowed; so is a step before the first
    reset or after the end. A reset before any step keeps the episode's number and
    replaces its first frame. Inside Gymnasium's `Autoreset` wrapper, the step after the
    end is a reset and starts the next episode.

    After `close`, calls go straight to the closed environment, and nothing is recorded.
    """

    allows_early_reset = False

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        camera: Any = None,
        height: int | None = None,
        width: int | None = None,
        env_id: str | None = None,
        env_index: int | None = None,
        rendering: Callable[[Path], Finisher] | None = None,
        close_environment: Callable[[Any], None] = close_environment,
        no_simulation: str = NO_SIMULATION,
    ) -> None:
        super().__init__(env)
        # gym's own convention: the step that ends an episode begins the next.
        self._same_step_autoreset = bool(env.metadata.get("semantics.autoreset"))
        self._next_step_autoreset = _has_autoreset(env)
        size = {"height": height, "width": width}
        first, frames = camera_frames(
            camera,
            lambda each: gymnasium_frames(env, camera=each, **size),
            tiled=options.tiled,
        )
        self._open(
            env,
            directory,
            options,
            scenes=lambda: gymnasium_scenes(env, camera=first, **size),
            close_environment=close_environment,
            no_simulation=no_simulation,
            rendering=rendering,
            env_id=env_id or env_id_of(env),
            env_index=env_index,
            view=recorded_view(camera, **size, own=own_camera(env)),
            **frames,
        )

    # Gymnasium's own wrappers override the attribute by a property too.
    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The environment's own: one made from it again is not monitored."""
        return self.env.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode.

        Raises:
            ResetNotAllowed: in the middle of an episode, unless early resets are
                allowed.
        """
        if self._recorder.closed:
            return self.env.reset(seed=seed, options=options)
        self._recorder.before_reset()
        with self._resetting():
            result = self.env.reset(seed=seed, options=options)
        self._begin(seed=seed, options=options, observation=result[0])
        return result

    def step(self, action: Any) -> _Step:
        """Step the environment and record what happened.

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode.
        """
        recorder = self._recorder
        fast = recorder.fast
        if fast is None or not fast.before_step(action):
            if recorder.closed:
                return self.env.step(action)
            if self._before_step(action):
                with self._resetting():
                    result = self.env.step(action)
                self._begin(observation=result[0])
                return result
        try:
            result = self.env.step(action)
        except BaseException as error:
            recorder.note_error(error)
            raise
        if fast is not recorder.fast:
            # Within the step this monitor was closed, or its process forked.
            fast = None
        _, reward, terminated, truncated, _ = result
        if fast is None or terminated or truncated or not fast.step(reward):
            self._record(*result)
        return result

    def _before_step(self, action: Any) -> bool:
        """Note an action; return whether the coming step is a reset instead."""
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
        """Record a step, and the reset that it was besides, if it was.

        Args:
            observation: of the step, as all up to `info`.
            reward: likewise.
            terminated: likewise.
            truncated: likewise.
            info: likewise; what it says of the episode is added to it.
            first_observation: of the episode that the step begins; `observation`, if
                None.
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
    """Return the name in an environment's spec; `(unknown:ClassName)` without one."""
    if env.spec is not None:
        return env.spec.id
    unknown = f"(unknown:{type(env.unwrapped).__name__})"
    logger.warning(
        "The environment has no spec, so the recordings cannot name it; they say %s. "
        "An environment made with gymnasium.make has one.",
        unknown,
    )
    return unknown


def success_in(info: Mapping[str, Any]) -> bool | None:
    """Return whether an episode was a success; None where nothing is said.

    Args:
        info: of its last step. `is_success` is looked at, else `success`: a truth
            value or a number, or an array of one.
    """
    # Gymnasium-Robotics' Fetch and Hand environments say the first, its Adroit and maze
    # environments the second, as MetaWorld and others do.
    for key in ("is_success", "success"):
        value = info.get(key)
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.item()
        if isinstance(value, bool | int | float | np.bool_ | np.number):
            return bool(value)
    return None


def _has_autoreset(env: gymnasium.Env[Any, Any]) -> bool:
    # A sub-environment that is seen from outside says so itself.
    if getattr(env, "resets_in_next_step", False):
        return True
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.Autoreset):
            return True
        env = env.env
    return False

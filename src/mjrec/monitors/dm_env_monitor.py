# SPDX-License-Identifier: Apache-2.0
"""The monitor for dm_env environments."""

from __future__ import annotations

import functools
import logging
import operator
import os
from typing import Any

import dm_env

from ..environments.named_environment import is_terminated, is_truncated
from ..environments.scenes import NoFrameSource, Scenes
from ..errors import InvalidArgument
from ..recorder.options import RecorderOptions
from .base import EnvironmentMonitor

logger = logging.getLogger(__name__)

_MID = dm_env.StepType.MID

_NO_PHYSICS = (
    "it has no physics to render, unlike dm_control's environments. Record a "
    "dm_control environment"
)


class DmEnvMonitor(EnvironmentMonitor, dm_env.Environment):  # type: ignore[misc]  # untyped
    """A monitor for a dm_env environment. Create it with `mjrec.Monitor`.

    It follows dm_env's contract: `reset` is allowed at any time, and a `step` before
    the first reset or after the last time step ignores its action and starts an
    episode. Such a step is recorded as a reset. Other attributes of the environment
    (`physics`, `task`, `control_timestep` ...) are also available.

    After `close`, calls go straight to the closed environment, and nothing is recorded.

    Attributes:
        seed: the next episode's seed, for the journal and the metadata. dm_env's
            `reset` takes no seed, so set this if you seed the environment yourself.
    """

    allows_early_reset = True

    def __init__(
        self,
        env: dm_env.Environment,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        env_id: str | None = None,
        **view: Any,
    ) -> None:
        self._env = env
        self.seed: Any = None
        if options.episode_info:
            raise InvalidArgument(
                "episode_info adds to the info of Gymnasium's steps, but dm_env's time "
                "steps have no info. The journal has every episode's return and length."
            )
        self._open(
            env,
            directory,
            options,
            scenes=functools.partial(_scenes, env, env_id),
            view=view,
            close_environment=operator.methodcaller("close"),
            env_id=env_id or _env_id(env),
        )

    def reset(self) -> dm_env.TimeStep:
        """Reset the environment and start an episode.

        Raises:
            ResetNotAllowed: an episode is running and `allow_early_reset=False` was
                given.
        """
        if self._recorder.closed:
            return self._env.reset()
        self._recorder.before_reset()
        timestep = self._reset_by(self._env.reset)
        self._begin(seed=self.seed, observation=timestep.observation)
        return timestep

    def step(self, action: Any) -> dm_env.TimeStep:
        """Step the environment and record the result."""
        recorder = self._recorder
        fast = recorder.fast
        if fast is None or not fast.before_step(action):
            if recorder.closed:
                return self._env.step(action)
            if recorder.done is not False:
                return self.reset()
            recorder.before_step(action)
        try:
            timestep = self._env.step(action)
        except BaseException as error:
            recorder.note_error(error)
            raise
        if fast is not recorder.fast:
            # The monitor was closed, or its process forked, during the step.
            fast = None
        is_between = timestep.step_type is _MID
        if fast is None or not is_between or not fast.step(timestep.reward):
            self._record(timestep)
        return timestep

    def observation_spec(self) -> Any:
        """Return the environment's observation spec."""
        return self._env.observation_spec()

    def action_spec(self) -> Any:
        """Return the environment's action spec."""
        return self._env.action_spec()

    def reward_spec(self) -> Any:
        """Return the environment's reward spec."""
        return self._env.reward_spec()

    def discount_spec(self) -> Any:
        """Return the environment's discount spec."""
        return self._env.discount_spec()

    def __getattr__(self, name: str) -> Any:
        # Called only for attributes not found here. `_env` itself is missing if the
        # constructor failed, or while an object is being copied.
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self._env, name)

    def _record(self, timestep: dm_env.TimeStep) -> None:
        if self._recorder.closed:
            return
        if timestep.first():
            # The environment was reset without the monitor.
            self._recorder.before_reset()
            self._begin(seed=self.seed, observation=timestep.observation)
            return
        self._recorder.step(
            0.0 if timestep.reward is None else timestep.reward,
            terminated=is_terminated(timestep),
            truncated=is_truncated(timestep),
            observation=timestep.observation,
        )


def _scenes(env: dm_env.Environment, env_id: str | None, **view: Any) -> Scenes:
    if getattr(env, "physics", None) is not None:
        from ..environments.dm_control_scenes import dm_control_scenes

        return dm_control_scenes(env, env_id=env_id, **view)
    if any(asked is not None for asked in view.values()):
        raise InvalidArgument(
            "camera, height and width apply only to dm_control environments, but "
            f"{type(env).__name__} has no physics."
        )
    return Scenes(frames=NoFrameSource(_NO_PHYSICS))


def _env_id(env: dm_env.Environment) -> str:
    unknown = f"(unknown:{type(getattr(env, 'task', env)).__name__})"
    logger.warning(
        "dm_env environments have no names, so the recordings say %s. To set "
        'the name, use Monitor(..., env_id="dm_control/cheetah-run").',
        unknown,
    )
    return unknown

# SPDX-License-Identifier: Apache-2.0
"""Tasks of the dm_control suite, created by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_control import suite as suite

from ..errors import UnknownName
from ..simulation.cameras import default_camera, resolve_camera
from .dm_control_scenes import MADE_WITH, dm_control_scenes, generator_of
from .episode_seeds import EpisodeSeeds
from .known_names import dm_control_failure
from .named_environment import (
    EnvironmentOptions,
    NamedEnvironment,
    Step,
    is_terminated,
    is_truncated,
)
from .names import task_of_suite
from .scenes import Scenes

SUITE_ARGUMENTS = ("task_kwargs", "environment_kwargs", "visualize_reward")


def make_dm_control(env_id: str, options: EnvironmentOptions) -> Any:
    """Create a task from the suite.

    The camera and the size apply to each frame, not to the environment. Episodes end
    after `max_steps`, or after 1000 steps if the task has no time limit.

    Args:
        env_id: `dm_control/<domain>-<task>`.
        options: the options. `kwargs` are arguments for `suite.load`: `{"task_kwargs":
            {...}, "environment_kwargs": {...}, "visualize_reward": true}`. `seed` seeds
            random choices made when a task is created, such as the springs of `lqr`,
            unless `task_kwargs` has its own `random`.

    Raises:
        UnknownName: the domain, task or argument does not exist.
        MissingDependency: the installed dm_control does not work with the installed
            mujoco.
        EnvironmentNotMade: creating the task failed for another reason, which is
            chained.
    """
    domain, task = task_of_suite(env_id)
    tasks = suite.TASKS_BY_DOMAIN.get(domain)
    if tasks is None:
        raise UnknownName(
            "dm_control domain",
            domain,
            suite.TASKS_BY_DOMAIN,
            hint="A dm_control environment's name is dm_control/<domain>-<task>.",
        )
    if task not in tasks:
        raise UnknownName(f"dm_control {domain} task", task, tasks)
    for name in options.kwargs:
        if name not in SUITE_ARGUMENTS:
            raise UnknownName(
                "dm_control environment argument",
                name,
                SUITE_ARGUMENTS,
                hint='For example {"task_kwargs": {"time_limit": 5}}.',
            )
    # suite.load accepts None for task_kwargs, so users may pass it.
    of_task = {"random": options.seed, **(options.kwargs.get("task_kwargs") or {})}
    try:
        kwargs = {**options.kwargs, "task_kwargs": of_task}
        return load_task(env_id, kwargs, options)
    except Exception as error:
        raise dm_control_failure(env_id, error) from error


def load_task(
    env_id: str, kwargs: Mapping[str, Any] | None, options: EnvironmentOptions
) -> Any:
    """Create a task with `suite.load`.

    Args:
        env_id: `dm_control/<domain>-<task>`.
        kwargs: arguments for `suite.load`; None if a recording lacks them. In that
            case, recordings of the returned environment also lack them.
        options: the options; only `max_steps` applies.
    """
    environment = suite.load(*task_of_suite(env_id), **(kwargs or {}))
    if kwargs is not None:
        # An environment does not store the arguments used to create it.
        setattr(environment.task, MADE_WITH, kwargs)
    # There is no public way to read or set a task's step limit.
    environment._step_limit = options.limit(environment._step_limit) or np.inf
    return environment


class DmControlEnvironment(NamedEnvironment):
    """A task of the suite.

    Args:
        env_id: `dm_control/<domain>-<task>`.
        options: the options; the camera and size are passed to the monitor.

    Raises:
        Error: see `make_dm_control`; also raised if the model has no such camera.
    """

    def __init__(self, env_id: str, options: EnvironmentOptions) -> None:
        self.env_id = env_id
        environment = self.environment = make_dm_control(env_id, options)
        self.step_limit = int(environment._step_limit)
        if options.frames:
            camera = options.camera
            if camera is None:
                camera = default_camera(environment.physics.model)
            resolve_camera(environment.physics.model, camera)
            self.view = {"camera": camera, **options.size}
        self._made_with = getattr(environment.task, MADE_WITH)["task_kwargs"]["random"]
        fresh = np.random.RandomState(self._made_with)
        states = (each.get_state() for each in (self._generator(), fresh))
        self.draws_when_made = not all(map(np.array_equal, *states))
        self._was_reset = False

    def begin(self, around: Any, seeds: EpisodeSeeds, seed: int | None) -> Any:
        """Reset, and return the first observation.

        dm_env's `reset` takes no seed. dm_control's tasks draw all their random numbers
        from one `RandomState`. It is seeded in place, because other objects share it. A
        monitor receives the seed for its metadata.

        If the environment was created with this seed and never reset, it is used
        exactly as `suite.load(..., task_kwargs={"random": seed})` created it. The
        random choices made during creation are kept, and no seed is set for this
        episode.
        """
        if not self._was_reset and seed == self._made_with:
            seed = None
        if seed is not None:
            self._generator().seed(seed)
        self._was_reset = True
        if not callable(getattr(around, "seed", print)):
            around.seed = seed
        return around.reset().observation

    def step(self, around: Any, action: Any) -> Step:
        """Take a step, and return its result."""
        timestep = around.step(action)
        return Step(
            timestep.observation,
            timestep.reward,
            is_terminated(timestep),
            is_truncated(timestep),
        )

    def scenes(self) -> Scenes:
        """Return how to record the environment's states and draw its frames."""
        return dm_control_scenes(self.environment)

    def _generator(self) -> Any:
        return generator_of(self.environment)

# SPDX-License-Identifier: Apache-2.0
"""Tasks of the dm_control suite by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from dm_control import suite

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
from .names import DmControlName
from .scenes import Scenes

_ARGUMENTS = ("task_kwargs", "environment_kwargs", "visualize_reward")


def tasks_of(domain: str) -> Sequence[str]:
    """Return the tasks that the installed suite has of a domain."""
    tasks: Sequence[str] = suite.TASKS_BY_DOMAIN.get(domain, ())
    return tasks


def make_dm_control(domain: str, task: str, options: EnvironmentOptions) -> Any:
    """Return a task of the suite.

    Camera and size belong to each frame, not to the environment. Episodes end after
    `max_steps`, or after 1000 steps where the task has
    no time limit.

    Args:
        domain: for example `cheetah`.
        task: for example `run`.
        options: `kwargs` are those of `suite.load`, `{"task_kwargs": {...},
            "environment_kwargs": {...}, "visualize_reward": true}`. `seed` seeds what
            a task draws when it is made, such as the springs of `lqr`, unless
            `task_kwargs` has a `random` of its own.

    Raises:
        UnknownName: there is no such domain or task, or argument.
        MissingDependency: this dm_control does not work with this mujoco.
        EnvironmentNotMade: making it failed otherwise; the cause is kept.
    """
    if domain not in suite.TASKS_BY_DOMAIN:
        raise UnknownName(
            "dm_control domain",
            domain,
            suite.TASKS_BY_DOMAIN,
            hint="An environment is named dm_control/<domain>-<task>.",
        )
    if task not in tasks_of(domain):
        raise UnknownName(f"task of dm_control's {domain}", task, tasks_of(domain))
    arguments = _arguments(options.kwargs)
    arguments["task_kwargs"] = {"random": options.seed, **arguments["task_kwargs"]}
    name = DmControlName(domain, task)
    try:
        environment = load_task(name, arguments)
    except Exception as error:
        raise dm_control_failure(str(name), error) from error
    environment._step_limit = options.limit(environment._step_limit)
    return environment


def load_task(
    name: DmControlName, kwargs: Mapping[str, Any] | None, *, limit: int | None = None
) -> Any:
    """Return a task as `suite.load` makes it.

    Args:
        name: of the task.
        kwargs: of `suite.load`; None where a recording does not know them: then neither
            does a recording of what is returned.
        limit: ends an episode as truncated, where the task does not end it before.
    """
    environment = suite.load(name.domain, name.task, **(kwargs or {}))
    if kwargs is not None:
        # Nothing in an environment says with which arguments it was made.
        setattr(environment.task, MADE_WITH, kwargs)
    if limit is not None:
        # Nothing public tells, or sets, the limit that a task's time makes.
        environment._step_limit = min(limit, environment._step_limit)
    return environment


class DmControlEnvironment(NamedEnvironment):
    """A task of the suite.

    Args:
        name: of the task.
        options: how it is made; camera and size are what the monitor is to be given.

    Raises:
        Error: of `make_dm_control`; or the model has no such camera.
    """

    def __init__(self, name: DmControlName, options: EnvironmentOptions) -> None:
        environment = make_dm_control(name.domain, name.task, options)
        view: dict[str, Any] = {}
        if options.frames:
            camera = options.camera
            if camera is None:
                camera = default_camera(environment.physics.model)
            resolve_camera(environment.physics.model, camera)
            view = {"camera": camera, **options.size}
        super().__init__(
            environment,
            env_id=str(name),
            step_limit=int(environment._step_limit),
            view=view,
        )
        self._made_with = getattr(environment.task, MADE_WITH)["task_kwargs"]["random"]
        self._draws_when_made = not _is_fresh(self._generator(), self._made_with)
        self._was_reset = False

    @property
    def draws_when_made(self) -> bool:
        """Whether its model depends on the seed that it was made with."""
        return self._draws_when_made

    def begin(self, around: Any, seeds: EpisodeSeeds, seed: int | None) -> Any:
        """Reset.

        dm_env's `reset` takes no seed. dm_control's tasks draw all their random numbers
        from one `RandomState`, which is seeded in place, because what else holds it
        must see the same. A monitor gets the seed for its metadata.

        An environment that was made with this seed and never reset is as
        `suite.load(..., task_kwargs={"random": seed})` made it: what it drew then stays
        drawn, and it was not seeded for this episode.
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
        """Step, and return what that gave."""
        timestep = around.step(action)
        return Step(
            timestep.observation,
            timestep.reward,
            is_terminated(timestep),
            is_truncated(timestep),
        )

    def scenes(self) -> Scenes:
        """Return what is known of its frames and its states."""
        return dm_control_scenes(self.environment)

    def _generator(self) -> Any:
        return generator_of(self.environment)


def _is_fresh(generator: Any, seed: Any) -> bool:
    """Return whether a generator, made with a seed, has drawn nothing."""
    states = (each.get_state() for each in (generator, np.random.RandomState(seed)))
    return all(map(np.array_equal, *states))


def _arguments(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    for name in kwargs:
        if name not in _ARGUMENTS:
            raise UnknownName(
                "argument of a dm_control environment",
                name,
                _ARGUMENTS,
                hint='For example {"task_kwargs": {"time_limit": 5}}.',
            )
    # suite.load takes None for both, and so may the person who asks.
    return {**kwargs, "task_kwargs": kwargs.get("task_kwargs") or {}}

# SPDX-License-Identifier: Apache-2.0
"""Tasks of the dm_control suite by their names."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np
from dm_control import suite

from ..errors import InvalidArgument, UnknownName
from .dm_control_failures import dm_control_failure
from .dm_env_episodes import StepLimit
from .episode_seeds import EpisodeSeeds
from .options import EnvironmentOptions

_ARGUMENTS = ("task_kwargs", "environment_kwargs", "visualize_reward")

# Nothing in an environment says with which arguments it was made.
_made: weakref.WeakKeyDictionary[Any, dict[str, Any]] = weakref.WeakKeyDictionary()
_never_reset: weakref.WeakSet[Any] = weakref.WeakSet()


def make_dm_control(
    domain: str, task: str, options: EnvironmentOptions
) -> dm_env.Environment:
    """Return a task of the suite.

    Camera and size are not the environment's but of each picture: whoever draws it
    gives them. Episodes end after `max_steps`, or after 1000 steps where the task has
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
    _check_name(domain, task)
    arguments = _arguments(options.kwargs)
    arguments["task_kwargs"] = {"random": options.seed, **arguments["task_kwargs"]}
    try:
        environment = suite.load(domain, task, **arguments)
    except Exception as error:
        raise dm_control_failure(f"dm_control/{domain}-{task}", error) from error
    _made[environment.task] = arguments
    _never_reset.add(environment.task)
    return _limited(environment, options)


def arguments_of(env: dm_env.Environment) -> dict[str, Any] | None:
    """Return what `suite.load` was given besides domain and task.

    Args:
        env: a task of the suite, or a wrapper that shows its `task`.

    Returns:
        None where it was not `make_dm_control` that made it.
    """
    try:
        return _made.get(getattr(env, "task", None))
    except TypeError:
        # No task, or one that can be no key.
        return None


def begin_episode(env: dm_env.Environment, seeds: EpisodeSeeds) -> Any:
    """Reset the environment, or a wrapper of it, to an episode's seeds.

    dm_env's `reset` takes no seed. dm_control's tasks draw all their random numbers
    from one `RandomState`, which is seeded in place, because what else holds it must
    see the same. A monitor is told the seed, for its metadata.

    Returns:
        The first observation.

    Raises:
        InvalidArgument: the environment has no random state.
    """
    _never_reset.discard(getattr(env, "task", None))
    _random_state(env).seed(seeds.environment)
    if not callable(getattr(env, "seed", print)):
        env.seed = seeds.environment
    return env.reset().observation


def begin_stream(env: dm_env.Environment, seed: int, seeds: EpisodeSeeds) -> Any:
    """Reset the environment, seeded for all episodes that follow.

    An environment that was made with this seed and never reset is not seeded again:
    it is as `suite.load(..., task_kwargs={"random": seed})` made it, and what it drew
    while it was made stays drawn. Any other begins the seed's sequence anew.

    Args:
        env: the environment, or a wrapper of it.
        seed: of the environment's randomness from here on.
        seeds: of this episode; nothing of dm_env takes one.

    Returns:
        The first observation.

    Raises:
        InvalidArgument: the environment has no random state.
    """
    made, task = arguments_of(env) or {}, getattr(env, "task", None)
    if made.get("task_kwargs", {}).get("random") != seed or task not in _never_reset:
        _random_state(env).seed(seed)
    return next_episode(env, seeds)


def next_episode(env: dm_env.Environment, seeds: EpisodeSeeds) -> Any:
    """Reset the environment, whose randomness goes on where it is.

    A monitor says of such an episode that it had no seed.

    Returns:
        The first observation.
    """
    _never_reset.discard(getattr(env, "task", None))
    if not callable(getattr(env, "seed", print)):
        env.seed = None
    return env.reset().observation


def draws_when_made(env: dm_env.Environment) -> bool:
    """Tell whether a task, which was just made, has drawn its model from its seed."""
    seed = (arguments_of(env) or {}).get("task_kwargs", {}).get("random")
    state = _random_state(env).get_state(legacy=False)["state"]
    fresh = np.random.RandomState(seed).get_state(legacy=False)["state"]
    return any(not np.array_equal(state[name], fresh[name]) for name in state)


def step_limit(env: dm_env.Environment) -> int:
    """Return after how many steps the episodes of what was made here end."""
    if isinstance(env, StepLimit):
        return env.max_steps
    # Nothing public tells it, and what is not limited by us has one.
    return int(env._step_limit)


def step(env: dm_env.Environment, action: Any) -> tuple[Any, bool]:
    """Return the next observation, and whether it is the episode's last."""
    timestep = env.step(action)
    return timestep.observation, timestep.last()


def _check_name(domain: str, task: str) -> None:
    if domain not in suite.TASKS_BY_DOMAIN:
        raise UnknownName(
            "dm_control domain",
            domain,
            suite.TASKS_BY_DOMAIN,
            hint="An environment is named dm_control/<domain>-<task>.",
        )
    tasks = suite.TASKS_BY_DOMAIN[domain]
    if task not in tasks:
        raise UnknownName(f"task of dm_control's {domain}", task, tasks)


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


def _limited(
    environment: dm_env.Environment, options: EnvironmentOptions
) -> dm_env.Environment:
    # Nothing public tells the limit that time_limit and control_timestep make.
    own = getattr(environment, "_step_limit", math.inf)
    limit = options.limit(own)
    return environment if limit >= own else StepLimit(environment, limit)


def _random_state(env: dm_env.Environment) -> np.random.RandomState:
    """Return what the suite's tasks, and composer's environments, draw from."""
    for holder, name in ((getattr(env, "task", None), "random"), (env, "random_state")):
        state = getattr(holder, name, None)
        if isinstance(state, np.random.RandomState):
            return state
    raise InvalidArgument(
        f"{type(env).__name__} cannot be seeded: it has neither task.random nor "
        "random_state, as dm_control's environments have."
    )

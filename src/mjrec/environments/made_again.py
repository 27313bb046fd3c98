# SPDX-License-Identifier: Apache-2.0
"""From what a recording says of its environment to that environment, or to a refusal.

A recording may come from anybody, and making an environment runs its code. So nothing
that a recording names is imported: an environment is made only where its id stands in
the installed registry already, as one of Gymnasium's own MuJoCo environments, of
Gymnasium-Robotics or of dm_control's suite, with arguments that are plain values and
name no file. The reader may trust further ids, one by one.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.envs import registration

from ..simulation.find_simulation import simulation_in
from .environment_arguments import VIEW_ARGUMENTS, shown_arguments
from .names import DmControlName, parse_environment_name
from .robotics_scenes import drawn_part
from .working_directory import working_directory_importable

UNKNOWN = "unknown"

# Where the registry's entry points of what is trusted without asking lie.
_OWN = "gymnasium.envs.mujoco"
_ROBOTICS = "gymnasium_robotics"

# gymnasium.make's own arguments, which are no environment's.
_MAKE = frozenset(("id", "vector_kwargs", "disable_env_checker", "max_episode_steps"))

# A word: no path, no name of a file, nothing with an extension.
_WORD = re.compile(r"[A-Za-z0-9_ -]{0,64}", re.ASCII)
_FILES = re.compile(r"(xml|model|mesh|asset|file|path|texture)", re.IGNORECASE)
_MOST_VALUES = 10_000

_SUITE_ARGUMENTS = ("task_kwargs", "environment_kwargs", "visualize_reward")


class NotMadeAgain(Exception):
    """An environment, or the beginning of an episode, is not made again.

    Its text is a clause that says why, and what to do.
    """


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """What a recording says of its environment.

    Attributes:
        framework: `gymnasium`, `dm_control` or `mjcf`.
        id: as it is registered.
        kwargs: that it was made with; None where the recording does not say.
        wrappers: between monitor and environment, by class; None likewise.
        max_episode_steps: the limit in force, None for none; `UNKNOWN` likewise.
    """

    framework: str
    id: str
    kwargs: Mapping[str, Any] | None
    wrappers: tuple[str, ...] | None
    max_episode_steps: int | str | None


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """What an episode was begun with.

    Attributes:
        seed: given to the reset; anything else than a number is none.
        random_state: of the environment's generators just before the reset.
        options: given to the reset.
    """

    seed: Any
    random_state: Any
    options: Any


class StepAgain(NamedTuple):
    """What a step gave."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool


class EnvironmentAgain(Protocol):
    """An environment that was made again.

    Attributes:
        is_settled: whether what follows from a state is computed after each step.
        is_all_in_state: whether it goes on from a state as if it had come there itself:
            it keeps nothing between steps that depends on where it has been.
        made_with: how it was made, as a clause for a report; "" where there is nothing
            to say.
    """

    is_settled: bool
    is_all_in_state: bool
    made_with: str

    def simulation(self) -> tuple[Any, Any]:
        """Return MuJoCo's own model and data of this moment."""

    def begin(self, start: EpisodeStart) -> Any:
        """Begin an episode as it was begun, and return the first observation.

        Raises:
            NotMadeAgain: what it was begun with is not known, or not plain.
        """

    def begin_anyhow(self) -> Any:
        """Begin an episode, whichever, and return its first observation.

        For an episode whose own beginning is not known. It may then be put into the
        recorded state, if it has all in its state.

        Raises:
            NotMadeAgain: its reset fails.
        """

    def step(self, action: Any) -> StepAgain:
        """Step the environment."""

    def close(self) -> None:
        """Close the environment."""


def recorded_environment(facts: Mapping[str, Any]) -> RecordedEnvironment:
    """Return what the facts of a recording say of its environment.

    Raises:
        NotMadeAgain: nothing, or nothing that could be.
    """
    said = facts.get("environment")
    if not isinstance(said, Mapping):
        raise NotMadeAgain("the recording does not say which environment it is of")
    framework, env_id = said.get("framework"), said.get("id")
    kwargs, wrappers = said.get("kwargs"), said.get("wrappers")
    limit = said.get("max_episode_steps", UNKNOWN)
    if (
        framework not in ("gymnasium", "dm_control", "mjcf")
        or not isinstance(env_id, str)
        or not isinstance(kwargs, Mapping | None)
        or not _is_limit(limit)
    ):
        raise NotMadeAgain(f"what it says of its environment cannot be: {said!r:.200}")
    return RecordedEnvironment(
        framework=framework,
        id=env_id,
        kwargs=kwargs,
        wrappers=_texts(wrappers),
        max_episode_steps=limit,
    )


def make_again(
    recorded: RecordedEnvironment, *, trust: frozenset[str] = frozenset()
) -> EnvironmentAgain:
    """Return the environment of a recording.

    Args:
        recorded: what the recording says of it.
        trust: further ids that the reader has named, `Id` or `module:Id`. The module
            is the reader's word, never the recording's.

    Raises:
        NotMadeAgain: the rule of trust forbids it, or it cannot be made here.
    """
    if recorded.wrappers:
        raise wrappers_refused(recorded.wrappers)
    match recorded.framework:
        case "gymnasium":
            return _gymnasium(recorded, trust)
        case "dm_control":
            return _dm_control(recorded)
    raise NotMadeAgain("it is of an MJCF file, which is made again from its sources")


def wrappers_refused(wrappers: tuple[str, ...]) -> NotMadeAgain:
    """Return what there is to say of wrappers, none of which is made again."""
    return NotMadeAgain(
        "wrappers stood between the monitor and the environment, and none is made "
        f"again: {', '.join(wrappers):.300}; what is recorded below them can be "
        "checked: put Monitor around the environment itself, and wrappers around the "
        "monitor"
    )


def made_with(recorded: RecordedEnvironment) -> str:
    """Return how an environment was made, as a clause; "" as it is by default."""
    if recorded.kwargs is None and recorded.framework == "dm_control":
        return "made with the suite's own arguments, as the recording names no others"
    said = shown_arguments(recorded.kwargs)
    return f"made with {said}" if said else ""


def is_installed_name(name: str) -> bool:
    """Tell whether a name is that of an environment that can be made here by it."""
    if name.startswith("dm_control/"):
        return _is_of_suite(name)
    return ":" not in name and _spec(name) is not None


def _is_of_suite(name: str) -> bool:
    try:
        from dm_control import suite

        parsed = _suite_name(name)
    # Where dm_control does not work none of its names is one that is installed.
    except Exception:
        return False
    return parsed.task in suite.TASKS_BY_DOMAIN.get(parsed.domain, ())


def plain_argument(name: str, value: Any) -> bool:
    """Tell whether an argument is a plain value, and names no file."""
    return not _FILES.search(name) and _is_plain(value, [_MOST_VALUES])


def _is_plain(value: Any, left: list[int]) -> bool:
    left[0] -= 1
    if left[0] < 0:
        return False
    if isinstance(value, list):
        return all(_is_plain(item, left) for item in value)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    return value is None or isinstance(value, bool | int | float)


def _is_limit(limit: Any) -> bool:
    if limit is None or limit is UNKNOWN:
        return True
    return type(limit) is int and limit > 0


def _texts(value: Any) -> tuple[str, ...] | None:
    if not isinstance(value, list):
        return None
    return tuple(str(item) for item in value)


def _arguments(recorded: RecordedEnvironment) -> dict[str, Any]:
    """Return what the environment is made with, but for how it is shown."""
    given = recorded.kwargs
    if given is None:
        raise NotMadeAgain(
            "it was made with arguments that a recording cannot hold, and so cannot "
            "be made again"
        )
    kept = {name: given[name] for name in given if name not in VIEW_ARGUMENTS}
    for name, value in kept.items():
        if name in _MAKE or not plain_argument(name, value):
            raise NotMadeAgain(
                f"its argument {name!r:.80} ({value!r:.80}) is more than a plain "
                "value, or names a file"
            )
    return kept


# Gymnasium ---------------------------------------------------------------------------


def _gymnasium(
    recorded: RecordedEnvironment, trust: frozenset[str]
) -> EnvironmentAgain:
    trusted = _trusted_id(recorded.id, trust)
    if trusted is None:
        _check_registered(recorded.id)
    arguments = _arguments(recorded)
    limit = recorded.max_episode_steps
    if limit is not UNKNOWN:
        # gymnasium.make's word for no limit.
        arguments["max_episode_steps"] = -1 if limit is None else limit
    here = working_directory_importable() if trusted else contextlib.nullcontext()
    with here, _failures(recorded.id):
        env = gymnasium.make(
            trusted or recorded.id, disable_env_checker=True, **arguments
        )
    entry_point = env.spec.entry_point if env.spec is not None else None
    return _GymnasiumAgain(
        env,
        is_all_in_state=_is_below(entry_point, _OWN),
        made_with=made_with(recorded),
    )


def _trusted_id(env_id: str, trust: frozenset[str]) -> str | None:
    """Return what the reader has named that is this id."""
    if env_id in trust:
        return env_id
    named = (each for each in trust if each.rpartition(":")[2] == env_id)
    return next(named, None)


def _check_registered(env_id: str) -> None:
    """Raise NotMadeAgain unless the installed registry holds a trusted id."""
    spec = None if ":" in env_id else _spec(env_id)
    entry_point = None if spec is None else spec.entry_point
    if not (_is_below(entry_point, _OWN) or _is_below(entry_point, _ROBOTICS)):
        raise NotMadeAgain(
            f"would run code from the archive: {env_id!r:.100} is none of the "
            "environments of Gymnasium's MuJoCo, Gymnasium-Robotics or dm_control that "
            f"are installed here. If you trust it: --trust {env_id:.100}"
        )


def _spec(env_id: str) -> registration.EnvSpec | None:
    spec = registration.registry.get(env_id)
    if spec is None and importlib.util.find_spec(_ROBOTICS) is not None:
        # It registers its environments when it is imported; its name is ours.
        with contextlib.suppress(Exception):
            importlib.import_module(_ROBOTICS)
        spec = registration.registry.get(env_id)
    return spec


def _is_below(entry_point: Any, package: str) -> bool:
    module = entry_point.partition(":")[0] if isinstance(entry_point, str) else ""
    return module == package or module.startswith(f"{package}.")


class _GymnasiumAgain:
    is_settled = False

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        is_all_in_state: bool,
        made_with: str,
    ) -> None:
        self.is_all_in_state = is_all_in_state
        self.made_with = made_with
        self._env = env
        self._base: Any = env.unwrapped
        if simulation_in(env) is None:
            env.close()
            raise NotMadeAgain("the environment has no MuJoCo simulation to be seen")

    def simulation(self) -> tuple[Any, Any]:
        holder = simulation_in(self._env)
        return (
            getattr(holder.model, "ptr", holder.model),
            getattr(holder.data, "ptr", holder.data),
        )

    def begin(self, start: EpisodeStart) -> Any:
        seed = start.seed if type(start.seed) is int else None
        if seed is None:
            self._set_random_state(start.random_state)
        options = _plain_options(start.options)
        with _failures("its reset"):
            return self._env.reset(seed=seed, options=options)[0]

    def begin_anyhow(self) -> Any:
        with _failures("its reset"):
            return self._env.reset(seed=0)[0]

    def step(self, action: Any) -> StepAgain:
        observation, reward, terminated, truncated, _ = self._env.step(action)
        return StepAgain(observation, float(reward), bool(terminated), bool(truncated))

    def close(self) -> None:
        self._env.close()

    def _set_random_state(self, state: Any) -> None:
        if not isinstance(state, Mapping):
            raise _unseeded()
        if "inner" not in state:
            _set_generator(self._base, state)
            return
        inner = drawn_part(self._base)
        for holder, part in ((self._base, state.get("env")), (inner, state["inner"])):
            if part is not None:
                _set_generator(holder, part)


def _set_generator(holder: Any, state: Any) -> None:
    generator = holder.np_random
    try:
        generator.bit_generator.state = _arrays(state)
    except (TypeError, ValueError, KeyError, OverflowError, AttributeError) as error:
        raise NotMadeAgain(f"its random state is none: {error!s:.200}") from error


def _unseeded() -> NotMadeAgain:
    return NotMadeAgain(
        "neither a seed nor a random state was recorded for the reset: give "
        "reset(seed=...) where episodes are to be begun again"
    )


def _plain_options(options: Any) -> dict[str, Any] | None:
    if options is None:
        return None
    plain = isinstance(options, Mapping) and all(
        isinstance(name, str) and plain_argument(name, value)
        for name, value in options.items()
    )
    if not plain:
        raise NotMadeAgain(
            f"the options of the reset ({options!r:.100}) are more than plain values"
        )
    return dict(options)


# dm_control --------------------------------------------------------------------------


def _dm_control(recorded: RecordedEnvironment) -> EnvironmentAgain:
    name = _suite_name(recorded.id)
    arguments = _suite_arguments(recorded.kwargs)
    limit = recorded.max_episode_steps
    return _DmControlAgain(
        name,
        arguments,
        limit if isinstance(limit, int) else None,
        made_with=made_with(recorded),
    )


def _suite_name(env_id: str) -> DmControlName:
    if env_id.startswith("dm_control/") and re.fullmatch(r"[\w/-]{1,100}", env_id):
        # No file is looked for under such a name.
        with contextlib.suppress(Exception):
            name = parse_environment_name(env_id)
            if isinstance(name, DmControlName):
                return name
    raise NotMadeAgain(f"{env_id!r:.100} is no task of dm_control's suite")


def _suite_arguments(kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    if kwargs is None:
        return {}
    arguments: dict[str, Any] = {}
    for name, value in kwargs.items():
        parts = value if isinstance(value, Mapping) else {name: value}
        if name not in _SUITE_ARGUMENTS or not all(
            isinstance(part, str) and plain_argument(part, parts[part])
            for part in parts
        ):
            raise NotMadeAgain(
                f"its argument {name!r:.80} ({value!r:.80}) is more than plain values"
            )
        arguments[name] = dict(value) if isinstance(value, Mapping) else value
    return arguments


class _DmControlAgain:
    is_settled = True
    is_all_in_state = True

    def __init__(
        self,
        name: DmControlName,
        arguments: dict[str, Any],
        limit: int | None,
        *,
        made_with: str,
    ) -> None:
        # dm_control is optional, and is loaded where one of its environments is asked
        # for; so is what knows it.
        try:
            from dm_control import suite

            from .dm_control_contexts import ContextsOnDemand
            from .dm_env_episodes import StepLimit, is_terminated, is_truncated
        except Exception as error:
            raise NotMadeAgain(
                f"dm_control does not work here ({error!s:.200}); pip install "
                '"mjrec[dm-control]"'
            ) from error
        if name.task not in suite.TASKS_BY_DOMAIN.get(name.domain, ()):
            raise NotMadeAgain(f"{name} is no task of the installed dm_control's suite")
        if name.domain == "lqr" and "random" not in arguments.get("task_kwargs", {}):
            raise NotMadeAgain(
                f"{name} draws its model at random when it is made, and from which "
                "seed is not recorded"
            )
        with _failures(str(name)):
            env = suite.load(name.domain, name.task, **arguments)
        # Nothing public tells the limit that time_limit and control_timestep make.
        own = getattr(env, "_step_limit", np.inf)
        self._env = env if limit is None or limit >= own else StepLimit(env, limit)
        self._inner = env
        self._resetting: Callable[[], Any] = ContextsOnDemand(env).resetting
        self._is_terminated, self._is_truncated = is_terminated, is_truncated
        self.made_with = made_with

    def simulation(self) -> tuple[Any, Any]:
        physics = self._inner.physics
        return physics.model.ptr, physics.data.ptr

    def begin(self, start: EpisodeStart) -> Any:
        generator = self._generator()
        if start.options:
            raise NotMadeAgain("dm_control's resets take no options")
        try:
            if start.random_state is not None:
                generator.set_state(_arrays(start.random_state))
            elif type(start.seed) is int:
                generator.seed(start.seed)
            else:
                raise _unseeded()
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise NotMadeAgain(f"its random state is none: {error!s:.200}") from error
        return self._reset()

    def begin_anyhow(self) -> Any:
        self._generator().seed(0)
        return self._reset()

    def step(self, action: Any) -> StepAgain:
        timestep = self._env.step(action)
        return StepAgain(
            observation=timestep.observation,
            reward=0.0 if timestep.reward is None else float(timestep.reward),
            terminated=self._is_terminated(timestep),
            truncated=self._is_truncated(timestep),
        )

    def close(self) -> None:
        self._env.close()

    def _reset(self) -> Any:
        with _failures("its reset"), self._resetting():
            return self._env.reset().observation

    def _generator(self) -> np.random.RandomState:
        state = getattr(self._inner.task, "random", None)
        if not isinstance(state, np.random.RandomState):
            raise NotMadeAgain("the task has no random state that could be set")
        return state


def _arrays(state: Any) -> Any:
    """Return a random state as NumPy takes it: with arrays for lists."""
    if isinstance(state, Mapping):
        return {name: _arrays(value) for name, value in state.items()}
    return np.array(state, dtype=np.uint64) if isinstance(state, list) else state


@contextlib.contextmanager
def _failures(what: str) -> Iterator[None]:
    """Turn whatever an environment's own code raises into a reason."""
    try:
        yield
    except Exception as error:
        raise NotMadeAgain(
            f"{what:.100} failed here: {type(error).__name__}: {error!s:.300}"
        ) from error

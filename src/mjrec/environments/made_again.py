# SPDX-License-Identifier: Apache-2.0
"""From what a recording says of its environment to that environment, or to a refusal.

It is made as from a name, with a shorter list of names. A recording may come from
anybody, and making an environment runs its code. So nothing that a recording names is
imported: an environment is made only where its id stands in the installed registry
already, as one of Gymnasium's own MuJoCo environments, of Gymnasium-Robotics or of
dm_control's suite, with arguments that are plain values and name no file. The reader
may trust further ids, one by one.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gymnasium.envs import registration

from .from_name import environment_from_name
from .gymnasium_environments import GymnasiumEnvironment
from .named_environment import EnvironmentOptions, NamedEnvironment, Step
from .names import DmControlName, GymnasiumName
from .scenes import VIEW_ARGUMENTS, shown_arguments, simulation_below

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

_SUITE_NAME = re.compile(r"dm_control/(\w{1,50})-(\w{1,50})")
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


@dataclass(frozen=True, kw_only=True)
class EnvironmentAgain:
    """An environment that was made again.

    Attributes:
        named: the environment.
        is_settled: whether what follows from a state is computed after each step.
        is_all_in_state: whether it goes on from a state as if it had come there itself:
            it keeps nothing between steps that depends on where it has been.
        made_with: how it was made, as a clause for a report; "" where there is nothing
            to say.
    """

    named: NamedEnvironment
    is_settled: bool = False
    is_all_in_state: bool = True
    made_with: str

    def simulation(self) -> tuple[Any, Any]:
        """Return MuJoCo's own model and data of this moment."""
        simulated = simulation_below(self.named.environment)
        model, data = simulated.model, simulated.data
        return getattr(model, "ptr", model), getattr(data, "ptr", data)

    def begin(self, start: EpisodeStart) -> Any:
        """Begin an episode as it was begun, and return the first observation.

        Raises:
            NotMadeAgain: what it was begun with is not known, or not plain.
        """
        options = start.options
        if options is not None and not (
            isinstance(options, Mapping) and all(map(_is_plain_item, options.items()))
        ):
            raise NotMadeAgain(
                f"the options of the reset ({options!r:.100}) are more than plain "
                "values"
            )
        seed = start.seed if type(start.seed) is int else None
        return self._begin(seed, start.random_state, options)

    def begin_anyhow(self) -> Any:
        """Begin an episode, whichever, and return its first observation.

        For an episode whose own beginning is not known. It may then be put into the
        recorded state, if it has all in its state.

        Raises:
            NotMadeAgain: its reset fails.
        """
        return self._begin(0, None, None)

    def step(self, action: Any) -> Step:
        """Step the environment."""
        step = self.named.step(self.named.environment, action)
        return step._replace(reward=float(step.reward or 0))

    def close(self) -> None:
        """Close the environment."""
        self.named.environment.close()

    def _begin(self, seed: int | None, state: Any, options: Any) -> Any:
        if self.named.is_random and seed is None and state is None:
            raise NotMadeAgain(
                "neither a seed nor a random state was recorded for the reset: give "
                "reset(seed=...) where episodes are to be begun again"
            )
        with _failures("its reset"):
            return self.named.begin_again(seed, state, options)


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
        or not (limit in (None, UNKNOWN) or (type(limit) is int and limit > 0))
    ):
        raise NotMadeAgain(f"what it says of its environment cannot be: {said!r:.200}")
    return RecordedEnvironment(
        framework=framework,
        id=env_id,
        kwargs=kwargs,
        wrappers=tuple(map(str, wrappers)) if isinstance(wrappers, list) else None,
        max_episode_steps=limit,
    )


def make_again(
    recorded: RecordedEnvironment,
    *,
    trust: frozenset[str] = frozenset(),
    model: Any = None,
) -> EnvironmentAgain:
    """Return the environment of a recording.

    Args:
        recorded: what the recording says of it.
        trust: further ids that the reader has named, `Id` or `module:Id`. The module
            is the reader's word, never the recording's.
        model: compiled from the sources in the archive, of an MJCF file's environment.

    Raises:
        NotMadeAgain: the rule of trust forbids it, or it cannot be made here.
    """
    if recorded.wrappers:
        raise NotMadeAgain(
            "wrappers stood between the monitor and the environment, and none is made "
            f"again: {', '.join(recorded.wrappers):.300}; what is recorded below them "
            "can be checked: put Monitor around the environment itself, and wrappers "
            "around the monitor"
        )
    match recorded.framework:
        case "gymnasium":
            return _gymnasium(recorded, trust)
        case "dm_control":
            return _dm_control(recorded)
    # It loads MuJoCo.
    from .mjcf_environments import make_mjcf

    with _failures(recorded.id):
        env = make_mjcf(Path("model.xml"), _options(recorded, {}), model)
    return EnvironmentAgain(
        named=GymnasiumEnvironment(env, is_random=False),
        made_with="made from the sources in the archive",
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
        return _suite_name(name) is not None
    return _entry_point(name) is not None


def _options(
    recorded: RecordedEnvironment, arguments: Mapping[str, Any]
) -> EnvironmentOptions:
    limit = recorded.max_episode_steps
    return EnvironmentOptions(
        pictures=False,
        # Where none was in force, none is.
        max_steps=limit if isinstance(limit, int) else sys.maxsize,
        kwargs=arguments,
    )


def _is_plain_item(item: tuple[Any, Any]) -> bool:
    """Tell whether an argument is a plain value, and names no file."""
    name, value = item
    return (
        isinstance(name, str)
        and not _FILES.search(name)
        and _is_plain(value, [_MOST_VALUES])
    )


def _is_plain(value: Any, left: list[int]) -> bool:
    left[0] -= 1
    if left[0] < 0:
        return False
    if isinstance(value, list):
        return all(_is_plain(item, left) for item in value)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    return value is None or isinstance(value, bool | int | float)


def _gymnasium(
    recorded: RecordedEnvironment, trust: frozenset[str]
) -> EnvironmentAgain:
    env_id = recorded.id
    trusted = {each.rpartition(":")[2]: each for each in trust}.get(env_id)
    entry_point = _entry_point(env_id)
    is_own = _is_below(entry_point, _OWN)
    if trusted is None and not (is_own or _is_below(entry_point, _ROBOTICS)):
        raise NotMadeAgain(
            f"would run code from the archive: {env_id!r:.100} is none of the "
            "environments of Gymnasium's MuJoCo, Gymnasium-Robotics or dm_control that "
            f"are installed here. If you trust it: --trust {env_id:.100}"
        )
    if recorded.kwargs is None:
        raise NotMadeAgain(
            "it was made with arguments that a recording cannot hold, and so cannot "
            "be made again"
        )
    arguments = {k: v for k, v in recorded.kwargs.items() if k not in VIEW_ARGUMENTS}
    for name, value in arguments.items():
        if name in _MAKE or not _is_plain_item((name, value)):
            raise NotMadeAgain(
                f"its argument {name!r:.80} ({value!r:.80}) is more than a plain "
                "value, or names a file"
            )
    arguments["disable_env_checker"] = True
    limit = recorded.max_episode_steps
    if limit is not UNKNOWN:
        # gymnasium.make's word for no limit.
        arguments["max_episode_steps"] = -1 if limit is None else limit
    with _failures(env_id):
        named = environment_from_name(
            GymnasiumName(trusted or env_id), _options(recorded, arguments)
        )
    if simulation_below(named.environment) is None:
        named.environment.close()
        raise NotMadeAgain("the environment has no MuJoCo simulation to be seen")
    return EnvironmentAgain(
        named=named, is_all_in_state=is_own, made_with=made_with(recorded)
    )


def _entry_point(env_id: str) -> Any:
    """Return where the installed registry says that an id's environment is defined."""
    spec = registration.registry.get(env_id)
    if spec is None and importlib.util.find_spec(_ROBOTICS) is not None:
        # It registers its environments when it is imported; its name is ours.
        with contextlib.suppress(Exception):
            importlib.import_module(_ROBOTICS)
        spec = registration.registry.get(env_id)
    return None if spec is None else spec.entry_point


def _is_below(entry_point: Any, package: str) -> bool:
    module = entry_point.partition(":")[0] if isinstance(entry_point, str) else ""
    return f"{module}.".startswith(f"{package}.")


def _dm_control(recorded: RecordedEnvironment) -> EnvironmentAgain:
    name = _suite_name(recorded.id)
    if name is None:
        raise NotMadeAgain(
            f"{recorded.id!r:.100} is no task of the installed dm_control's suite, or "
            'that does not work here: pip install "mjrec[dm-control]"'
        )
    arguments = recorded.kwargs or {}
    for key, value in arguments.items():
        parts = value if isinstance(value, Mapping) else {key: value}
        if key not in _SUITE_ARGUMENTS or not all(map(_is_plain_item, parts.items())):
            raise NotMadeAgain(
                f"its argument {key!r:.80} ({value!r:.80}) is more than plain values"
            )
    with _failures(recorded.id):
        if name.domain == "lqr" and "random" not in arguments.get("task_kwargs", {}):
            raise NotMadeAgain(
                f"{name} draws its model at random when it is made, and from which "
                "seed is not recorded"
            )
        named = environment_from_name(name, _options(recorded, arguments))
    return EnvironmentAgain(named=named, is_settled=True, made_with=made_with(recorded))


def _suite_name(env_id: str) -> DmControlName | None:
    """Return the name of a task that the installed suite has; None for another."""
    # Where dm_control does not work none of its names is one that is installed.
    with contextlib.suppress(Exception):
        from .dm_control_environments import tasks_of

        match = _SUITE_NAME.fullmatch(env_id)
        if match and match[2] in tasks_of(match[1]):
            return DmControlName(match[1], match[2])
    return None


@contextlib.contextmanager
def _failures(what: str) -> Iterator[None]:
    """Turn whatever an environment's own code raises into a reason."""
    try:
        yield
    except NotMadeAgain:
        raise
    except Exception as error:
        raise NotMadeAgain(
            f"{what:.100} failed here: {type(error).__name__}: {error!s:.300}"
        ) from error

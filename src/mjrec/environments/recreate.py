# SPDX-License-Identifier: Apache-2.0
"""Functions that recreate the environment of a recording if this is safe.

A recording may be untrusted, and creating an environment runs the environment's code.
So no module named in a recording is imported. An environment is created only if its id
is already in the installed registry and belongs to Gymnasium itself, Gymnasium-Robotics
or dm_control's suite. Its arguments must be plain values within bounds and name no
files. Wrappers must be Gymnasium's own, and their arguments must meet the same
conditions. The reader may trust more ids individually.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs import registration
from numpy.typing import NDArray

from ..formats.trajectory import columns_of
from .gymnasium_environments import make_registered, registered_spec
from .gymnasium_scenes import drawn_part, random_state, set_own_camera
from .named_environment import EnvironmentOptions
from .scenes import class_name, generator_state, set_generator_state, simulation_below
from .wrapping import StandIn, stand_ins

# Packages whose entry points in the registry are trusted by default.
_TRUSTED = (
    *("gymnasium.envs.mujoco", "gymnasium.envs.classic_control"),
    *("gymnasium.envs.toy_text", "gymnasium_robotics"),
)
_ROBOTICS = "gymnasium_robotics"

# Arguments for gymnasium.make itself, not for an environment.
_MAKE = frozenset(("id", "vector_kwargs", "disable_env_checker", "max_episode_steps"))

# A plain word, which cannot be a path or a file name with an extension.
_WORD = re.compile(r"[A-Za-z0-9_ -]{0,64}", re.ASCII)
_FILES = re.compile(r"(xml|model|mesh|asset|file|path|texture)", re.IGNORECASE)
_RENDER_MODES = (None, "rgb_array", "rgb_array_list", "ansi", "depth_array")
_MOST_VALUES = 10_000
_LARGEST = 1e9
# The limit for numbers that affect memory or time: frames, skipped frames, stacks. A
# suite task's `random` is a seed, so the limit does not apply to it.
_LARGEST_COUNT = 10_000


class NotRecreated(Exception):
    """An environment cannot be recreated.

    The message is a clause that gives the reason and a remedy.

    Args:
        reason: the clause.
        excuse: the component that the reader lacks: "environment" or "wrappers"; None
            if the inputs are impossible for any reader.
    """

    def __init__(self, reason: str, *, excuse: str | None = None) -> None:
        super().__init__(reason)
        self.excuse = excuse


@dataclass(frozen=True, kw_only=True)
class Recreated:
    """A recreated environment.

    Attributes:
        environment: a `gymnasium.Env` or a `dm_env.Environment`.
        is_dm_env: whether the environment is a `dm_env.Environment`.
        stand_in: the wrapper that replays recorded steps if the recorded wrappers are
            not available; otherwise None.
    """

    environment: Any
    is_dm_env: bool = False
    stand_in: StandIn | None = None

    def random_state(self) -> Any:
        """Return the state of the random generators, in the form used in recordings."""
        if self.is_dm_env:
            return generator_state(self._dm_generator())
        return random_state(self.environment.unwrapped)

    def set_random_state(self, state: Any) -> None:
        """Set the environment's random generators to a recorded state.

        Raises:
            NotRecreated: the state does not fit the generators.
        """
        try:
            if self.is_dm_env:
                set_generator_state(self._dm_generator(), state)
                return
            base: Any = self.environment.unwrapped
            parts = state if "inner" in state else {"env": state, "inner": None}
            for holder, part in ((base, "env"), (drawn_part(base), "inner")):
                if parts[part] is not None:
                    set_generator_state(holder.np_random, parts[part])
        except Exception as error:
            raise NotRecreated(
                f"its random state does not fit the environment: {error!s:.100}"
            ) from error

    def seed(self, seed: int) -> None:
        """Seed dm_control's generator; Gymnasium environments are seeded by `reset`."""
        self._dm_generator().seed(seed)

    def seed_behind(self, state: Any) -> int | None:
        """Return the seed that produced an unused generator's state, or None.

        This works only for dm_control, because the state of NumPy's legacy generator
        starts with its seed.
        """
        key = state.get("state", {}).get("key") if isinstance(state, Mapping) else None
        if not self.is_dm_env or not isinstance(key, list) or not key:
            return None
        seed = key[0]
        if type(seed) is not int or not 0 <= seed < 2**32:
            return None
        fresh = generator_state(np.random.RandomState(seed))
        return seed if fresh == state else None

    def enter(self, state: NDArray[Any], observation: Any) -> Any:
        """Set Gymnasium's simulation to a recorded state, and return the observation.

        Args:
            state: a row of a trajectory's states.
            observation: the observation to return if a new one cannot be computed.
        """
        self.put_into(state)
        observe = getattr(self.environment.unwrapped, "_get_obs", None)
        return observation if observe is None else observe()

    def put_into(self, state: NDArray[Any]) -> None:
        """Set the simulation to a recorded state, unless the state is unknown.

        Args:
            state: a row of a trajectory's states; NaN if unknown.
        """
        from ..simulation.states import enter_state  # This loads MuJoCo.

        simulated = simulation_below(self.environment)
        row = state.view(np.float64).reshape(-1)
        if np.isfinite(row).all():
            parts = columns_of(state.dtype)
            enter_state(simulated.model, simulated.data, parts, row)

    def turns_by_rk4(self) -> bool:
        """Return whether MuJoCo 4 steps the model differently by design."""
        from ..simulation.states import turns_by_rk4  # This loads MuJoCo.

        simulated = simulation_below(self.environment)
        return simulated is not None and turns_by_rk4(simulated.model)

    def _dm_generator(self) -> Any:
        from .dm_control_scenes import generator_of

        return generator_of(self.environment)


def recreate(
    recorded: Mapping[str, Any],
    *,
    own_camera: int | str | None = None,
    trust: frozenset[str] = frozenset(),
    mjcf: tuple[Path, Any] | None = None,
    is_elsewhere: bool = False,
) -> Recreated:
    """Recreate the environment of a recording.

    Args:
        recorded: `framework`, `id`, `kwargs`, `wrappers` and so on, from the journal.
        own_camera: the environment's own camera, if it was set after creation.
        trust: additional ids that the reader trusts, `Id` or `module:Id`. The module
            must come from the reader, never from the recording.
        mjcf: the author's MJCF file and its model, for an environment made from a file.
        is_elsewhere: whether the recording claims other versions than those here.

    Raises:
        NotRecreated: the environment is not trusted, or cannot be created here.
    """
    env_id, kwargs = recorded.get("id"), recorded.get("kwargs")
    limit = recorded.get("max_episode_steps")
    if not isinstance(env_id, str) or not (
        limit is None or (type(limit) is int and 0 < limit <= _LARGEST)
    ):
        raise NotRecreated(
            f"its description of the environment is invalid: {recorded!r:.200}"
        )
    if not isinstance(kwargs, Mapping | None):
        raise NotRecreated(f"its arguments are invalid: {kwargs!r:.100}")
    trusted = {each.rpartition(":")[2]: each for each in trust}.get(env_id)
    # The author's version may take arguments that the reader's does not.
    is_other = is_elsewhere or trusted is not None
    with _failures(env_id, excuse="environment" if is_other else None):
        match recorded.get("framework"):
            case "gymnasium":
                env = _gymnasium(env_id, kwargs, limit, trusted)
            case "dm_control":
                if recorded.get("wrappers"):
                    raise _wrappers_refused(recorded["wrappers"])
                return _dm_control(env_id, kwargs, limit)
            case "mjcf" if mjcf is not None:
                env = _mjcf(*mjcf, kwargs or {}, limit)
            case "mjcf":
                raise _lacking("its model's sources are not in the archive")
            case framework:
                raise NotRecreated(f"its framework, {framework!r:.80}, does not exist")
        if own_camera is not None:
            set_own_camera(env, own_camera)
        return _wrapped(env, recorded)


def checked_options(options: Any) -> dict[str, Any] | None:
    """Return the options of a reset if they are plain values.

    Raises:
        NotRecreated: the options are not plain values.
    """
    if options is None:
        return None
    if not isinstance(options, Mapping) or not _are_plain(options):
        raise NotRecreated(
            f"the reset options ({options!r:.100}) contain more than plain values"
        )
    return dict(options)


def _gymnasium(
    env_id: str,
    kwargs: Mapping[str, Any] | None,
    limit: int | None,
    trusted: str | None,
) -> gymnasium.Env[Any, Any]:
    spec = _known_spec(env_id) if trusted is None else registered_spec(trusted)
    if spec is None:
        raise _lacking(
            f"this would run code from the archive: {env_id!r:.100} is not one of the "
            "environments of Gymnasium, Gymnasium-Robotics or dm_control that are "
            f"installed here. If you trust it, use --trust {env_id:.100}"
        )
    if kwargs is None:
        raise _lacking("it was created with arguments that a recording cannot store")
    for name, value in kwargs.items():
        is_shown = name != "render_mode" or value in _RENDER_MODES
        if name in _MAKE or not is_shown or not _is_plain_item(name, value):
            raise _lacking(
                f"its argument {name!r:.80} ({value!r:.80}) is not a plain "
                "value within bounds, or names a file"
            )
    # The recorded limit replaces the registered one; -1 is gymnasium.make's for none.
    of_make = {"max_episode_steps": limit or -1, "disable_env_checker": True}
    return make_registered(spec, _options(None, kwargs={**kwargs, **of_make}))


def _options(limit: int | None, **others: Any) -> EnvironmentOptions:
    return EnvironmentOptions(max_steps=limit or np.inf, frames=False, **others)


def _wrapped(env: gymnasium.Env[Any, Any], recorded: Mapping[str, Any]) -> Recreated:
    """Wrap an environment in a recording's wrappers, or in stand-ins."""
    names = [str(name) for name in recorded.get("wrappers") or ()]
    arguments = recorded.get("wrapper_arguments") or [None] * len(names)
    if len(arguments) != len(names):
        raise _wrappers_refused(names)
    kinds = [_known_wrapper(*each) for each in zip(names, arguments, strict=True)]
    if None in kinds:
        if simulation_below(env) is None:
            raise _wrappers_refused(names)
        outermost, stand_in = stand_ins(env, names, arguments)
        return Recreated(environment=outermost, stand_in=stand_in)
    for kind, given in reversed(list(zip(kinds, arguments, strict=True))):
        assert kind is not None
        env = kind(env, **given)
    return Recreated(environment=env)


def _known_wrapper(name: str, given: Any) -> Callable[..., Any] | None:
    """Return Gymnasium's wrapper with this name if its arguments are plain, or None."""
    kind = getattr(gymnasium.wrappers, name.rpartition(".")[2], None)
    if not isinstance(kind, type) or class_name(kind) != name:
        return None
    is_plain = isinstance(given, Mapping) and _are_plain(given)
    return kind if is_plain else None


def _wrappers_refused(names: Any) -> NotRecreated:
    return NotRecreated(
        "there were wrappers between the monitor and the environment that are not "
        f"Gymnasium's own with plain arguments: {', '.join(map(str, names)):.300}; put "
        "Monitor around the environment itself, and wrappers around the monitor",
        excuse="wrappers",
    )


def _mjcf(
    path: Path, model: Any, kwargs: Mapping[str, Any], limit: int | None
) -> gymnasium.Env[Any, Any]:
    # Not imported at the top, because it loads MuJoCo.
    from .mjcf_environments import make_mjcf

    size = {name: kwargs[name] for name in ("height", "width") if name in kwargs}
    return make_mjcf(path, _options(limit, **size), model)


def _dm_control(
    env_id: str, kwargs: Mapping[str, Any] | None, limit: int | None
) -> Recreated:
    names: Collection[str] = ()
    # If dm_control does not work, none of its tasks counts as installed.
    with contextlib.suppress(Exception):
        from .dm_control_environments import SUITE_ARGUMENTS, load_task, suite

        names = {f"dm_control/{domain}-{task}" for domain, task in suite.ALL_TASKS}
    if env_id not in names:
        raise _lacking(
            f"{env_id!r:.100} is not a task of the installed dm_control suite, or "
            'dm_control does not work here: pip install "mjrec[dm-control]"'
        )
    for key, value in (kwargs or {}).items():
        parts = value if isinstance(value, Mapping) else {key: value}
        if key not in SUITE_ARGUMENTS or not _are_plain(parts):
            raise _lacking(
                f"its argument {key!r:.80} ({value!r:.80}) is not a plain value "
                "within bounds"
            )
    task_kwargs = (kwargs or {}).get("task_kwargs") or {}
    if env_id.startswith("dm_control/lqr-") and "random" not in task_kwargs:
        raise _lacking(
            f"{env_id} chooses its model at random when it is created, and the "
            "seed for this is not recorded"
        )
    env = load_task(env_id, kwargs, _options(limit))
    return Recreated(environment=env, is_dm_env=True)


def _are_plain(arguments: Mapping[str, Any]) -> bool:
    """Return whether all arguments are plain values within bounds, naming no files."""
    return all(_is_plain_item(*item) for item in arguments.items())


def _is_plain_item(name: Any, value: Any) -> bool:
    """Return whether an argument is a plain value within bounds that names no file."""
    if not isinstance(name, str) or _FILES.search(name):
        return False
    if name != "random" and isinstance(value, int) and abs(value) > _LARGEST_COUNT:
        return False
    return _is_plain(value, [_MOST_VALUES])


def _is_plain(value: Any, left: list[int]) -> bool:
    left[0] -= 1
    if left[0] < 0:
        return False
    if isinstance(value, list):
        return all(_is_plain(item, left) for item in value)
    if isinstance(value, Mapping):
        items = (_is_plain_item(name, item) for name, item in value.items())
        return len(value) < _MOST_VALUES and all(items)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    if isinstance(value, bool) or value is None:
        return True
    return isinstance(value, int | float) and abs(value) <= _LARGEST


def _known_spec(env_id: str) -> registration.EnvSpec | None:
    """Return an id's spec if it is in the installed registry and trusted, or None."""
    spec = registration.registry.get(env_id)
    if spec is None and importlib.util.find_spec(_ROBOTICS) is not None:
        # The package registers its environments on import. The name is our constant.
        with contextlib.suppress(Exception):
            importlib.import_module(_ROBOTICS)
        spec = registration.registry.get(env_id)
    if spec is None or not isinstance(spec.entry_point, str):
        return None
    module = spec.entry_point.partition(":")[0]
    is_trusted = any(f"{module}.".startswith(f"{each}.") for each in _TRUSTED)
    return spec if is_trusted else None


@contextlib.contextmanager
def _failures(what: str, *, excuse: str | None) -> Iterator[None]:
    """Convert any exception in an environment's own code to `NotRecreated`."""
    try:
        yield
    except NotRecreated:
        raise
    except Exception as error:
        raise NotRecreated(
            f"{what:.100} failed here: {type(error).__name__}: {error!s:.300}",
            excuse=excuse,
        ) from error


def _lacking(reason: str) -> NotRecreated:
    return NotRecreated(reason, excuse="environment")

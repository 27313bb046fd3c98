# SPDX-License-Identifier: Apache-2.0
"""The facts that a monitor needs to record an environment's states and frames."""

from __future__ import annotations

import itertools
import math
import sys
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..simulation.find_simulation import simulation_in

if TYPE_CHECKING:
    from ..recorder.recorded_environment import EpisodeFrames
    from ..simulation.capture import Capture

# Arguments that affect only how an environment is shown, not its states or rewards.
VIEW_ARGUMENTS: Final = frozenset(
    (
        *("render_mode", "camera_name", "camera_id", "default_camera_config"),
        *("width", "height", "max_geom", "visual_options"),
    )
)
_MOST_CHARACTERS = 400


class NoFrameSource:
    """The source of frames for an environment that cannot be drawn live.

    Args:
        missing: a clause that states what is missing, and a remedy.
    """

    render_mode = None

    def __init__(self, missing: str) -> None:
        self.missing = missing

    def render(self) -> None:
        """Return None, because there is no frame."""

    def facts(self) -> dict[str, Any]:
        """Return an empty dict, because there is no video."""
        return {}


_NO_FRAMES: Final = NoFrameSource("")


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """How to record an environment's states, and whether they determine its frames.

    Attributes:
        states: the capture of the states; None if no MuJoCo simulation was found.
        obstacle: why frames of the environment cannot be drawn from its states, as a
            clause that names the overriding class; None if only missing states prevent
            it.
        environment: the facts needed to recreate the environment: `framework`
            (`"gymnasium"`, `"dm_control"` or `"mjcf"`), `id` and `kwargs` (None if
            unknown or not representable in JSON); None if the environment has no name.
        random_state: a function that returns the current state of the environment's
            random generators as JSON-compatible values, or None if there is no
            generator yet. It does not create a generator.
        frames: the source of live frames.
        own_view: the `own_camera` that the environment itself shows, for the journal;
            empty for a free camera. The camera may differ from the environment's
            arguments, because it can be changed after creation.
    """

    states: Capture | None = None
    obstacle: str | None = None
    environment: dict[str, Any] | None = None
    random_state: Callable[[], Any] = lambda: None
    frames: EpisodeFrames = _NO_FRAMES
    own_view: Mapping[str, Any] = field(default_factory=dict)


def simulation_below(env: Any) -> Any:
    """Return the object that holds an environment's MuJoCo model and data, or None.

    Our own environments keep them in a separate object.
    """
    base = getattr(env, "unwrapped", env)
    return simulation_in(base) or simulation_in(getattr(base, "simulation", None))


def mujoco_warnings(env: Any) -> dict[str, int]:
    """Return the counts of MuJoCo's warnings since the last reset, by kind."""
    simulated = simulation_below(env)
    if simulated is None:
        return {}
    # Imported here because it loads MuJoCo, which some environments do not need.
    from ..simulation.warnings import warning_counts

    return warning_counts(simulated)


def new_warnings(before: Mapping[str, int], env: Any) -> dict[str, int]:
    """Return the counts of MuJoCo's warnings, by kind, that are not in `before`."""
    after = mujoco_warnings(env)
    # MuJoCo may reset an unstable simulation together with its counts.
    counts = {name: n - before.get(name, 0) for name, n in after.items()}
    counts = {name: n if n >= 0 else after[name] for name, n in counts.items()}
    return {name: n for name, n in counts.items() if n}


def is_defined_by(function: object, module: str, qualified_name: str) -> bool:
    """Return whether a function is defined in a module's own source.

    A replacement does not count, even if it has the same name or a decorator copied the
    name.

    Args:
        function: a function, or any other object.
        module: the module's full name. The module is not imported, because it is
            already loaded if it is in use.
        qualified_name: the function's qualified name in the module, for example
            `Wrapper.render`.
    """
    loaded = sys.modules.get(module)
    code = getattr(function, "__code__", None)
    return (
        loaded is not None
        and getattr(function, "__globals__", None) is vars(loaded)
        and getattr(code, "co_qualname", None) == qualified_name
    )


def has_own_method(instance: Any, name: str) -> bool:
    """Return whether an object has a method of its own, instead of its class's method.

    This function does not use `__dict__`, because in CPython 3.11 and 3.12, a single
    read makes every later access to the object's attributes several times slower. That
    increases the instruction count of a HalfCheetah step by 2%.
    """
    own = getattr(instance, name, None)
    of_class = getattr(instance.__class__, name, None)
    if own is of_class:
        return False
    # A weak proxy provides no access to the object itself.
    is_stand_in = type(instance) in weakref.ProxyTypes
    is_bound = is_stand_in or getattr(own, "__self__", None) is instance
    function = getattr(own, "__func__", None)
    return of_class is None or not (is_bound and function is of_class)


def render_override(
    what: str, drawn: Any, known: Iterable[tuple[str, str]]
) -> str | None:
    """Return the reason why frames may differ if `render` is overridden, or None.

    Args:
        what: a noun that describes `drawn`, for the returned reason.
        drawn: the object whose `render` is called.
        known: the modules and qualified names of the functions that do not count as
            overriding `render`.
    """
    # A weak proxy's type is not the object's class.
    kind = drawn.__class__
    if not has_own_method(drawn, "render"):
        if any(is_defined_by(kind.render, *each) for each in known):
            return None
        kind = next((k for k in kind.__mro__ if "render" in vars(k)), kind)
    return f"the {what} {class_name(kind)} overrides render()"


def class_name(kind: type) -> str:
    """Return the full name of a class."""
    return f"{kind.__module__}.{kind.__qualname__}"


def generator_state(generator: Any) -> Any:
    """Return the state of a NumPy random generator, as JSON-compatible values.

    Args:
        generator: a `Generator`, a `RandomState`, or None, whose state is None.
    """
    if isinstance(generator, np.random.Generator):
        return _lists(generator.bit_generator.state)
    if isinstance(generator, np.random.RandomState):
        return _lists(generator.get_state(legacy=False))
    return None


def set_generator_state(generator: Any, state: Any) -> None:
    """Set a NumPy random generator to a state that `generator_state` returned.

    Raises:
        Exception: the state does not fit the generator.
    """
    if isinstance(generator, np.random.RandomState):
        generator.set_state(_arrays(state))
    else:
        generator.bit_generator.state = _arrays(state)


def plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return arguments as JSON-compatible values, or None if that is impossible.

    Tuples become lists, and NumPy scalars become plain numbers.
    """
    try:
        plain: dict[str, Any] = _plain(arguments)
        return plain
    except TypeError:
        return None


def shown_arguments(kwargs: Any) -> str:
    """Return the arguments used to create an environment, as `name=value, ...`.

    Args:
        kwargs: the arguments from a recording; any value is accepted.

    Returns:
        The arguments, without those that affect only the view; "" if none are left.
    """
    if not isinstance(kwargs, Mapping):
        return ""
    shown = ", ".join(
        f"{name}={value!r:.100}"
        for name, value in kwargs.items()
        if name not in VIEW_ARGUMENTS
    )
    if len(shown) > _MOST_CHARACTERS:
        return f"{shown[:_MOST_CHARACTERS]} ..."
    return shown


def shown_wrappers(environment: Mapping[str, Any]) -> list[str]:
    """Return `Name(argument=value, ...)` for each wrapper, outermost first.

    Args:
        environment: the facts about the environment in a recording; any values are
            accepted.
    """
    names, arguments = (
        given if isinstance(given := environment.get(key), list) else []
        for key in ("wrappers", "wrapper_arguments")
    )
    shown = []
    for name, given in itertools.zip_longest(names, arguments[: len(names)]):
        known = ["..."]
        if isinstance(given, Mapping):
            known = [f"{key}={value!r:.100}" for key, value in given.items()]
        shown.append(f"{name}({', '.join(known)})")
    return shown


def _lists(value: Any) -> Any:
    """Return `value` with NumPy arrays and scalars converted to lists and numbers."""
    if isinstance(value, dict):
        return {name: _lists(item) for name, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _arrays(state: Any) -> Any:
    """Return a random state in NumPy's format, with lists converted to arrays."""
    if isinstance(state, Mapping):
        return {name: _arrays(value) for name, value in state.items()}
    return np.array(state, dtype=np.uint64) if isinstance(state, list) else state


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    raise TypeError(value)

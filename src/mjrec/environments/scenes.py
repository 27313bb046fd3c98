# SPDX-License-Identifier: Apache-2.0
"""What a monitor needs to know of an environment to record its states and frames."""

from __future__ import annotations

import itertools
import math
import sys
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..simulation.find_simulation import simulation_in

if TYPE_CHECKING:
    from ..simulation.capture import Capture

# How an environment is shown, on which no state and no reward depends.
VIEW_ARGUMENTS: Final = frozenset(
    (
        *("render_mode", "camera_name", "camera_id", "default_camera_config"),
        *("width", "height", "max_geom", "visual_options"),
    )
)
_MOST_CHARACTERS = 400


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """How an environment's states are recorded, and whether frames follow from them.

    Attributes:
        states: takes them down; None where no MuJoCo simulation can be seen.
        obstacle: why what the environment shows cannot be drawn from its states, as a
            clause that names the class that overrides; None where nothing but a lack
            of states is in the way.
        environment: what it takes to make the environment again: `framework`
            (`"gymnasium"`, `"dm_control"` or `"mjcf"`), `id` and `kwargs` (None where
            they are unknown, or more than JSON can hold); None where it has no name.
        random_state: returns the state of the environment's random generators now, as
            JSON can hold it; None where there is none yet. It makes none.
    """

    states: Capture | None = None
    obstacle: str | None = None
    environment: dict[str, Any] | None = None
    random_state: Callable[[], Any] = lambda: None


class NoFrameSource:
    """Stands for the frames of an environment that cannot be drawn live.

    Args:
        missing: what the environment lacks, and what to do about it.
    """

    render_mode = None

    def __init__(self, missing: str) -> None:
        self.missing = missing

    def render(self) -> None:
        """Return None: there is no frame."""

    def facts(self) -> dict[str, Any]:
        """Return nothing: there is no video."""
        return {}


def simulation_below(env: Any) -> Any:
    """Return what has the MuJoCo model and data of an environment; None for nothing.

    An environment of ours keeps them in an object of its own.
    """
    base = getattr(env, "unwrapped", env)
    return simulation_in(base) or simulation_in(getattr(base, "simulation", None))


def new_warnings(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """Return which of MuJoCo's warnings have come, of two `warning_counts`."""
    # An unstable simulation may be set back, and its counts with it.
    counts = {name: n - before.get(name, 0) for name, n in after.items()}
    counts = {name: n if n >= 0 else after[name] for name, n in counts.items()}
    return {name: n for name, n in counts.items() if n}


def is_defined_by(function: object, module: str, qualified_name: str) -> bool:
    """Return whether a function is the one that a module's own source defines.

    What was put in its place (a function of that name from elsewhere, also under a
    decorator that copies names) is not.

    Args:
        function: a function, or anything.
        module: its full name. It is not imported: what is in use is loaded.
        qualified_name: of the function in it, for example `Wrapper.render`.
    """
    loaded = sys.modules.get(module)
    code = getattr(function, "__code__", None)
    return (
        loaded is not None
        and getattr(function, "__globals__", None) is vars(loaded)
        and getattr(code, "co_qualname", None) == qualified_name
    )


def has_own_method(instance: Any, name: str) -> bool:
    """Return whether an object has a method itself that its class has otherwise.

    Asks not for `__dict__`: an object that was asked for it once finds each of its
    attributes several times as slowly ever after (CPython 3.11 and 3.12), which adds
    2 % to the instructions of a HalfCheetah step.
    """
    own = getattr(instance, name, None)
    of_class = getattr(instance.__class__, name, None)
    if own is of_class:
        return False
    # What a weak reference stands for is not to be had from it.
    is_stand_in = type(instance) in weakref.ProxyTypes
    is_bound = is_stand_in or getattr(own, "__self__", None) is instance
    function = getattr(own, "__func__", None)
    return of_class is None or not (is_bound and function is of_class)


def overriding_class(kind: type, name: str) -> str:
    """Return the full name of the class that gives `kind` its method `name`."""
    return class_name(next((k for k in kind.__mro__ if name in vars(k)), kind))


def class_name(kind: type) -> str:
    """Return the full name of a class."""
    return f"{kind.__module__}.{kind.__qualname__}"


def generator_state(generator: Any) -> Any:
    """Return the state of one of NumPy's random generators, as JSON can hold it.

    Args:
        generator: a `Generator`, a `RandomState`, or None, whose state is None.
    """
    if isinstance(generator, np.random.Generator):
        return _lists(generator.bit_generator.state)
    if isinstance(generator, np.random.RandomState):
        return _lists(generator.get_state(legacy=False))
    return None


def set_generator_state(generator: Any, state: Any) -> None:
    """Put one of NumPy's random generators into a state that `generator_state` gave.

    Raises:
        Exception: it is no state of such a generator.
    """
    if isinstance(generator, np.random.RandomState):
        generator.set_state(_arrays(state))
    else:
        generator.bit_generator.state = _arrays(state)


def plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return arguments as JSON can hold them; None if one of them is more than that.

    Tuples become lists, and NumPy's scalars the numbers that they hold.
    """
    try:
        return {_text(name): _plain(value) for name, value in arguments.items()}
    except TypeError:
        return None


def shown_arguments(kwargs: Any) -> str:
    """Return `name=value, ...` of what an environment was made with.

    Args:
        kwargs: as a recording has them; they may be anything.

    Returns:
        "" where there are none but for how it is shown.
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
    """Return `Name(argument=value, ...)` of each wrapper, outermost first.

    Args:
        environment: as a recording has it; the values may be anything.
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
    """Return `value` with lists and plain numbers for NumPy's."""
    if isinstance(value, dict):
        return {name: _lists(item) for name, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _arrays(state: Any) -> Any:
    """Return a random state as NumPy takes it: with arrays for lists."""
    if isinstance(state, Mapping):
        return {name: _arrays(value) for name, value in state.items()}
    return np.array(state, dtype=np.uint64) if isinstance(state, list) else state


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {_text(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    raise TypeError(value)


def _text(name: Any) -> str:
    if not isinstance(name, str):
        raise TypeError(name)
    return name

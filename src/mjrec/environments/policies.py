# SPDX-License-Identifier: Apache-2.0
"""Policies: what chooses the actions of an episode.

=================  ==================================================================
`random`           each action is drawn from the environment's actions
`zero`             each action is zero, or as near to it as the bounds allow
`module:name`      an object with `predict` (Stable-Baselines3) or a function is the
                   policy; a class is built with the environment and then is one of
                   these
`module:name()`    is called with the environment and returns one of these
=================  ==================================================================

A policy is called with the observation, for dm_env that of the time step, and returns
an action. If it has a `reset`, that is called with a seed at the start of each episode.
The generators that a process shares (`random`, `numpy.random`, PyTorch's) are seeded
with the same.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from ..errors import Error, PolicyError, UnknownName
from .episode_seeds import EpisodeSeeds
from .working_directory import working_directory_importable

_BUILT_IN = ("random", "zero")
_FORMS = (
    "Or give module:name (a class, a function or an object of yours) or module:name()."
)


class Policy(Protocol):
    """What chooses the actions."""

    def reset(self, seeds: EpisodeSeeds) -> None:
        """Prepare for an episode that has these seeds; before its first action."""

    def __call__(self, observation: Any) -> Any:
        """Return the action at an observation, checked.

        Raises:
            PolicyError: the policy raised, or gave something that is no action.
        """


class Actions(Protocol):
    """The actions that an environment takes."""

    def seed(self, seed: int) -> None:
        """Begin the sequence of drawn actions that belongs to a seed."""

    def draw(self) -> Any:
        """Return a random action."""

    def zero(self) -> Any:
        """Return the action nearest to zero."""

    def checked(self, action: Any) -> Any:
        """Return an action as the environment takes it, or raise `PolicyError`."""


def load_policy(text: str, environment: Any) -> Policy:
    """Return the policy that `text` names; the module says what it may name.

    The working directory is importable while this runs. A policy that imports more
    from there later on needs `working_directory_importable` around its use.

    Args:
        text: `random`, `zero`, `module:name` or `module:name()`.
        environment: the Gymnasium or dm_env environment that is to be acted in.

    Raises:
        UnknownName: there is no such policy, module or name in it.
        PolicyError: importing or building it raised, which is kept as the cause, or
            what it names is no policy.
    """
    actions = _actions(environment)
    match text:
        case "random":
            return _RandomPolicy(actions)
        case "zero":
            return _ZeroPolicy(actions)
    with working_directory_importable():
        chosen = _chosen(text, environment)
    return _ForeignPolicy(text, _chooser(text, chosen), actions)


def policy_from(chosen: Any, name: str, environment: Any) -> Policy:
    """Return the policy that an object is, as `load_policy` treats `module:name`.

    Args:
        chosen: an object with `predict`, a function, or a class, which is built with
            the environment and then is one of these.
        name: what messages call it.
        environment: the Gymnasium or dm_env environment that is to be acted in.

    Raises:
        PolicyError: building it raised, which is kept as the cause, or it is no
            policy.
    """
    if inspect.isclass(chosen):
        chosen = _built(chosen, name, environment)
    return _ForeignPolicy(name, _chooser(name, chosen), _actions(environment))


def policy_file(text: str) -> Path | None:
    """Return the file of the module that a policy, which is loaded, comes from.

    Args:
        text: as given to `load_policy`.

    Returns:
        None for the built-in ones, and for modules that are in no file.
    """
    module = sys.modules.get(text.partition(":")[0]) if ":" in text else None
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file)


class _RandomPolicy:
    def __init__(self, actions: Actions) -> None:
        self._actions = actions

    def reset(self, seeds: EpisodeSeeds) -> None:
        self._actions.seed(seeds.actions)

    def __call__(self, observation: Any) -> Any:
        return self._actions.draw()


class _ZeroPolicy:
    def __init__(self, actions: Actions) -> None:
        self._zero = actions.zero()

    def reset(self, seeds: EpisodeSeeds) -> None:
        """Do nothing: zero is zero."""

    def __call__(self, observation: Any) -> Any:
        # Environments may keep, or write into, the action that they are given.
        return self._zero.copy() if hasattr(self._zero, "copy") else self._zero


class _Chooser(Protocol):
    """A foreign policy in one form."""

    def reset(self, seed: int) -> None: ...

    def __call__(self, observation: Any) -> Any: ...


class _ForeignPolicy:
    """Guards a policy of the user's: names what raises, checks what it gives."""

    def __init__(self, text: str, chooser: _Chooser, actions: Actions) -> None:
        self._text = text
        self._chooser = chooser
        self._actions = actions

    def reset(self, seeds: EpisodeSeeds) -> None:
        with _failures_named(f"reset({seeds.policy}) of the policy {self._text}"):
            self._chooser.reset(seeds.policy)

    def __call__(self, observation: Any) -> Any:
        with _failures_named(f"The policy {self._text}"):
            action = self._chooser(observation)
        return self._actions.checked(action)


class _Function:
    """Calls what is called with the observation."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function

    def reset(self, seed: int) -> None:
        _reset_if_it_can(self._function, seed)

    def __call__(self, observation: Any) -> Any:
        return self._function(observation)


class _Predictor:
    """Calls `predict` as Stable-Baselines3 defines it, for one environment.

    Recurrent policies get back the state that they returned, and are told which
    observation is the first of its episode; an argument that a `predict` does not take
    is left out.
    """

    def __init__(self, predictor: Any) -> None:
        self._predictor = predictor
        self._state: Any = None
        self._first = True
        self._takes = _options_of(predictor.predict)

    def reset(self, seed: int) -> None:
        self._state = None
        self._first = True
        _reset_if_it_can(self._predictor, seed)

    def __call__(self, observation: Any) -> Any:
        known = {
            "state": self._state,
            "episode_start": np.array([self._first]),
            "deterministic": True,
        }
        arguments = {name: known[name] for name in known if self._takes(name)}
        predicted = self._predictor.predict(observation, **arguments)
        self._first = False
        if isinstance(predicted, tuple) and len(predicted) == 2:
            action, self._state = predicted
            return action
        return predicted


def _actions(environment: Any) -> Actions:
    # Of each framework only what the environment has loaded already is imported.
    actions: Actions
    if callable(getattr(environment, "action_spec", None)):
        from .dm_env_actions import DmEnvActions

        actions = DmEnvActions(environment.action_spec())
    else:
        from .gymnasium_actions import GymnasiumActions

        actions = GymnasiumActions(environment.action_space)
    return actions


def _chosen(text: str, environment: Any) -> Any:
    """Return the object, or what the class or call gives, that `text` names."""
    module_name, colon, name = text.partition(":")
    called = name.endswith("()")
    name = name.removesuffix("()")
    if not (module_name and colon and name):
        raise UnknownName("policy", text, _BUILT_IN, hint=_FORMS)
    found = _find(_import(module_name, text), name)
    if not called and not inspect.isclass(found):
        return found
    if not callable(found):
        raise PolicyError(
            f"The policy {text} is to be called, and {name} is {found!r}, which cannot "
            f"be. Leave the parentheses away: {module_name}:{name}."
        )
    return _built(found, text, environment)


def _built(make: Callable[[Any], Any], name: str, environment: Any) -> Any:
    with _failures_named(f"Building the policy {name} with the environment"):
        return make(environment)


def _import(module_name: str, text: str) -> ModuleType:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _failure(f"Importing {module_name} for the policy {text}") from error
        raise UnknownName(
            "module for a policy",
            module_name,
            _modules_here(),
            hint=f"Looked in {Path.cwd()} and among what is installed.",
        ) from error
    except Exception as error:
        raise _failure(f"Importing {module_name} for the policy {text}") from error


def _modules_here() -> list[str]:
    return sorted(p.stem for p in Path.cwd().glob("*.py") if p.stem.isidentifier())


def _find(module: ModuleType, name: str) -> Any:
    found: Any = module
    for part in name.split("."):
        if not hasattr(found, part):
            raise UnknownName(f"name in {module.__name__}", name, _offered(module))
        found = getattr(found, part)
    return found


def _offered(module: ModuleType) -> list[str]:
    """Return the names of what a module has that could be a policy."""
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (callable(value) or hasattr(value, "predict"))
        # Not what it imported itself; an object of a foreign class is its own.
        and getattr(value, "__module__", module.__name__) == module.__name__
    )


def _chooser(text: str, chosen: Any) -> _Chooser:
    # A policy of Stable-Baselines3 is a torch module too, and callable.
    if callable(getattr(chosen, "predict", None)):
        return _Predictor(chosen)
    if callable(chosen):
        return _Function(chosen)
    raise PolicyError(
        f"The policy {text} gives {chosen!r}, which neither can be called nor has "
        "predict()."
    )


def _reset_if_it_can(policy: Any, seed: int) -> None:
    reset = getattr(policy, "reset", None)
    if callable(reset):
        reset(seed)


def _options_of(predict: Callable[..., Any]) -> Callable[[str], bool]:
    """Return what tells whether `predict` takes an argument beside the observation."""
    parameters = inspect.signature(predict).parameters
    # The first one is the observation, whatever it is called: `state`, for example.
    names = list(parameters)[1:]
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    return lambda name: takes_all or name in names


@contextlib.contextmanager
def _failures_named(what: str) -> Iterator[None]:
    try:
        yield
    except Error:
        raise
    except Exception as error:
        raise _failure(what) from error


def _failure(what: str) -> PolicyError:
    """Return the error for the exception that is being handled, with its place."""
    _, error, trace = sys.exc_info()
    text = f"{what} raised {type(error).__name__}: {error}"
    # A syntax error says itself where it is.
    if not isinstance(error, SyntaxError):
        place = traceback.extract_tb(trace)[-1]
        text += f" ({place.filename}, line {place.lineno})"
    return PolicyError(f"{text}.")

# SPDX-License-Identifier: Apache-2.0
"""Policies, which choose the actions in an episode.

=================  ==================================================================
`random`           each action is sampled from the action space
`zero`             each action is zero, or as close to zero as the bounds allow
`module:name`      an object with `predict` (Stable-Baselines3) or a function; a
                   class is called with the environment to create one of these
`module:name()`    a function that is called with the environment and returns one of
                   these
`model.zip`        a file: see `policy_files`
=================  ==================================================================

A policy is called with the observation (with dm_env, the time step's observation) and
returns an action. If it has a `reset` method, this is called with a seed at the start
of each episode. The process's global generators (`random`, `numpy.random` and
PyTorch's) are seeded with the same seed.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import inspect
import logging
import operator
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final

import numpy as np

from ..errors import Error, InvalidArgument, PolicyError, UnknownName
from .episode_seeds import EpisodeSeeds
from .names import working_directory_importable
from .policy_files import file_of_policy, policy_in_file

logger = logging.getLogger(__name__)

_BUILT_IN = ("random", "zero")
_FORMS = (
    "Or pass module:name (a class, a function or an object), module:name(), "
    "or a file (model.zip of Stable-Baselines3, .pt of TorchScript, .onnx)."
)
_NONE: Final[Mapping[str, Any]] = MappingProxyType({})


class Policy:
    """A policy for one environment. This class implements the built-in policies.

    Args:
        environment: the Gymnasium or dm_env environment to act in.
        name: `random` or `zero`.
    """

    def __init__(self, environment: Any, name: str) -> None:
        # Not imported at the top, because it loads Gymnasium.
        from . import actions

        self._space = actions.action_space(environment)
        self._draw = actions.sampler(self._space)
        self._zero = actions.zero(self._space) if name == "zero" else None
        self._checked = actions.checked

    def reset(self, seeds: EpisodeSeeds) -> None:
        """Prepare for an episode with these seeds, before the first action."""
        self._space.seed(seeds.actions)

    def __call__(self, observation: Any) -> Any:
        """Return a checked action for an observation.

        Raises:
            PolicyError: the policy raised an exception, or returned an invalid action.
        """
        if self._zero is None:
            return self._draw()
        # Environments may keep or modify the action that they receive.
        return copy.deepcopy(self._zero)


class _ForeignPolicy(Policy):
    """A user's policy. Errors include its name, and its actions are checked."""

    def __init__(self, environment: Any, name: str, chosen: Any) -> None:
        super().__init__(environment, name)
        self._name = name
        self._reset = getattr(chosen, "reset", None)
        # A Stable-Baselines3 policy is also a torch module, and so callable.
        if callable(getattr(chosen, "predict", None)):
            self._choose: Callable[[Any], Any] = _Predictor(chosen)
        elif callable(chosen):
            self._choose = chosen
        else:
            raise PolicyError(
                f"The policy {name} is {chosen!r}, which is not callable and has no "
                "predict()."
            )

    def reset(self, seeds: EpisodeSeeds) -> None:
        if isinstance(self._choose, _Predictor):
            self._choose.begin()
        if callable(self._reset):
            with _failures_named(f"reset({seeds.policy}) of the policy {self._name}"):
                self._reset(seeds.policy)

    def __call__(self, observation: Any) -> Any:
        with _failures_named("The policy ", self._name):
            action = self._choose(observation)
        return self._checked(self._space, action)


class _Predictor:
    """A function that calls a Stable-Baselines3 policy's `predict` for one environment.

    Recurrent policies receive their last returned state and whether the observation is
    the first in its episode. Arguments that `predict` does not accept are left out.
    """

    def __init__(self, predictor: Any) -> None:
        self._predict = predictor.predict
        parameters = inspect.signature(self._predict).parameters
        # The first parameter is the observation, even if its name is `state`.
        self._taken = set(list(parameters)[1:])
        if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            self._taken = {"state", "episode_start", "deterministic"}
        self.begin()

    def begin(self) -> None:
        self._state: Any = None
        self._first = True

    def __call__(self, observation: Any) -> Any:
        known = {
            "state": self._state,
            "episode_start": np.array([self._first]),
            "deterministic": True,
        }
        arguments = {name: known[name] for name in known if name in self._taken}
        predicted = self._predict(observation, **arguments)
        self._first = False
        if isinstance(predicted, tuple) and len(predicted) == 2:
            action, self._state = predicted
            return action
        return predicted


def load_policy(
    text: str, environment: Any, kwargs: Mapping[str, Any] = _NONE
) -> Policy:
    """Load the policy named by `text`; the module docstring lists the forms.

    The working directory is importable during this call. A policy that later imports
    modules from there must be used inside `working_directory_importable`.

    Args:
        text: `random`, `zero`, `module:name`, `module:name()` or a file.
        environment: the Gymnasium or dm_env environment to act in.
        kwargs: arguments for calling a class or function, or for reading a file.

    Raises:
        UnknownName: the policy, the module, the name in it or the file does not exist.
        InvalidArgument: `kwargs` is given, but this kind of policy takes no arguments.
        PolicyError: importing, reading or creating the policy raised an exception,
            which is chained, or the result is not a policy.
        MissingDependency: the package that reads this type of file is missing.
    """
    if text in _BUILT_IN:
        _check_no_arguments(text, kwargs)
        return Policy(environment, text)
    with working_directory_importable():
        path = file_of_policy(text)
        if path is not None:
            with _failures_named(f"Reading the policy {text}"):
                chosen = policy_in_file(path, environment, **kwargs)
            return _ForeignPolicy(environment, text, chosen)
        return policy_from(_found(text), text, environment, kwargs)


def policy_from(
    chosen: Any, name: str, environment: Any, kwargs: Mapping[str, Any] = _NONE
) -> Policy:
    """Create a policy from an object, as `load_policy` does for `module:name`.

    Args:
        chosen: an object with `predict`, a function, or a class, which is called with
            the environment to create one of these.
        name: the policy's name in messages. If it ends in `()`, `chosen` is called too.
        environment: the Gymnasium or dm_env environment to act in.
        kwargs: additional arguments for calling `chosen`.

    Raises:
        InvalidArgument: `kwargs` is given, but `chosen` is not called.
        PolicyError: creating the policy raised an exception, which is chained, or the
            result is not a policy.
    """
    if inspect.isclass(chosen) or name.endswith("()"):
        try:
            inspect.signature(chosen).bind(environment, **kwargs)
        except TypeError as error:
            parameter = f"that{' and for --policy-kwargs' if kwargs else ''}"
            raise PolicyError(
                f"The policy {name} cannot be called with the environment: {error}. "
                f"Give it a parameter for {parameter}."
            ) from error
        except ValueError:
            # Some classes written in C have no signature.
            pass
        with _failures_named(f"Creating the policy {name} with the environment"):
            chosen = chosen(environment, **kwargs)
    else:
        _check_no_arguments(name, kwargs)
    return _ForeignPolicy(environment, name, chosen)


def policy_file(text: str) -> Path | None:
    """Return the file from which a policy was loaded.

    Args:
        text: the name that was passed to `load_policy`.

    Returns:
        The file, or None for built-in policies and modules without a file.
    """
    if ":" not in text:
        return file_of_policy(text)
    module = sys.modules.get(text.partition(":")[0])
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file)


def _check_no_arguments(name: str, kwargs: Mapping[str, Any]) -> None:
    if kwargs:
        raise InvalidArgument(
            f"The policy {name} takes no arguments, but these were given: "
            f"{dict(kwargs)}. Only a class, module:name() and a file take arguments."
        )


def _found(text: str) -> Any:
    """Return the object that `text` names."""
    module_name, colon, name = text.partition(":")
    attribute = name.removesuffix("()")
    if not (module_name and colon and attribute):
        raise UnknownName("policy", text, _BUILT_IN, hint=_FORMS)
    module = _import(module_name, text)
    try:
        found = operator.attrgetter(attribute)(module)
    except AttributeError as error:
        kind = f"name in {module.__name__}"
        raise UnknownName(kind, attribute, _offered(module)) from error
    if attribute != name and not callable(found):
        raise PolicyError(
            f"The policy {text} must be callable, but {attribute} is {found!r}. "
            f"Remove the parentheses: {text[:-2]}."
        )
    return found


def _import(module_name: str, text: str) -> ModuleType:
    with _failures_named(f"Importing {module_name} for the policy {text}"):
        try:
            return importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            # The missing module may also be one that this module imports.
            if not f"{module_name}.".startswith(f"{error.name}."):
                raise
            raise UnknownName(
                "policy module",
                module_name,
                sorted(
                    p.stem for p in Path.cwd().glob("*.py") if p.stem.isidentifier()
                ),
                hint=f"Looked in {Path.cwd()} and in the installed packages.",
            ) from error


def _offered(module: ModuleType) -> list[str]:
    """Return the names of objects in a module that could be policies."""
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (callable(value) or hasattr(value, "predict"))
        # Leave out imported objects, but not the module's own instances of classes.
        and getattr(value, "__module__", module.__name__) == module.__name__
    )


@contextlib.contextmanager
def _failures_named(*what: str) -> Iterator[None]:
    """Convert exceptions in third-party code to a PolicyError with the location."""
    try:
        yield
    except Error:
        raise
    except Exception as error:
        text = f"{''.join(what)} raised {type(error).__name__}: {error}"
        # A syntax error's message includes its location.
        if not isinstance(error, SyntaxError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            text += f" ({place.filename}, line {place.lineno})"
            _log_traceback(error, place.filename, place.lineno)
        raise PolicyError(f"{text}.") from error


_logged: set[tuple[object, ...]] = set()


def _log_traceback(error: BaseException, *where: object) -> None:
    """Log the traceback of an exception in third-party code, once for each location."""
    if (type(error), *where) not in _logged:
        _logged.add((type(error), *where))
        own = error.__traceback__
        while own is not None and own.tb_frame.f_code.co_filename == __file__:
            own = own.tb_next
        lines = traceback.format_exception(type(error), error, own)
        logger.warning("%s", "".join(lines).rstrip())

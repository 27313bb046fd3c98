# SPDX-License-Identifier: Apache-2.0
"""The names of the installed environments, for task sets and patterns.

Frameworks are queried in a separate process, `python -m
mjrec.environments.known_names`. dm_control chooses its rendering backend on import, and
a query for names must not make that choice for the calling process.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import sys
from collections.abc import Iterable, Sequence
from types import FrameType
from typing import Any

from ..child_python import Child
from ..errors import EnvironmentNotMade, Error, MissingDependency
from ..messages import Parent

_VERSION = re.compile(r"-v([0-9]+)$", re.ASCII)
_SUITE = "dm_control"
_GYMNASIUM = "gymnasium"

# Importing tasks such as `lqr` is slow on a busy machine, but never takes this long.
_TIMEOUT_S = 300


def suite_tasks(tag: str) -> tuple[str, ...]:
    """Return the sorted names `dm_control/<domain>-<task>` for part of the suite.

    Args:
        tag: `benchmarking`, `easy`, `hard`, `extra`, or `all`.

    Raises:
        MissingDependency: dm_control is not installed, or does not work with the
            installed mujoco.
        EnvironmentNotMade: importing dm_control failed for another reason.
    """
    answer = _ask(_SUITE, tag)
    if "names" in answer:
        return tuple(answer["names"])
    raised, text = ImportError, str(answer.get("text"))
    if answer.get("kind") == ModuleNotFoundError.__name__:
        raised = ModuleNotFoundError
    raise dm_control_failure(f"dm_control:{tag}", raised(text, name=answer.get("name")))


def gymnasium_ids(module: str | None = None) -> tuple[str, ...]:
    """Return the ids in Gymnasium's registry.

    Args:
        module: a module that registers environments on import. If given, only its ids
            are returned.

    Raises:
        EnvironmentNotMade: the module cannot be imported.
    """
    answer = _ask(_GYMNASIUM, module or "")
    if "names" in answer:
        return tuple(answer["names"])
    raise EnvironmentNotMade(
        f"{module}:" if module else "the list of Gymnasium's environments",
        f"importing it raised {answer.get('kind')}: {answer.get('text')}",
        hint="It must be installed, or be in the working directory.",
    )


def mujoco_ids() -> tuple[str, ...]:
    """Return the newest versions of Gymnasium's own MuJoCo environments."""
    return tuple(newest_versions(gymnasium_ids("gymnasium.envs.mujoco")).values())


def newest_versions(env_ids: Iterable[str]) -> dict[str, str]:
    """Return the newest version of each id, keyed by the id without its version.

    An id without a version is kept only if no versioned form exists.
    """
    newest: dict[str, str] = {}
    for env_id in sorted(env_ids, key=version_of):
        newest[_VERSION.sub("", env_id)] = env_id
    return newest


def version_of(env_id: str) -> int:
    """Return the version at the end of an id, or -1 if it has none."""
    match = _VERSION.search(env_id)
    return int(match[1]) if match else -1


def dm_control_failure(name: str, error: Exception) -> Error:
    """Return the error to raise when importing dm_control or loading a task has failed.

    Args:
        name: the environment's name.
        error: the exception.
    """
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing in ("dm_control", "dm_env"):
        return MissingDependency(
            "dm_control", purpose=name, install='pip install "mjrec[dm-control]"'
        )
    # dm_control 1.0.50 reads fields of MuJoCo's structs that are missing from mujoco 4.
    if re.search(r"Mj(Model|Data)\b.* has no attribute", str(error)):
        dm_control, mujoco = map(importlib.metadata.version, ("dm-control", "mujoco"))
        return MissingDependency(
            "a compatible mujoco (below version 4)",
            purpose=f"{name}: dm_control {dm_control} does not work with mujoco "
            f"{mujoco} ({error}) and",
            install='pip install "mujoco<4"',
        )
    return EnvironmentNotMade(name, f"{type(error).__name__}: {error}")


def _ask(*arguments: str) -> dict[str, Any]:
    """Return a child process's answer: `names`, or an error's `kind` and `text`."""
    # Listing names needs no OpenGL, and GLFW would complain without a display.
    environ = {**os.environ, "MUJOCO_GL": "disabled"}
    with Child(__name__, *arguments, environ=environ) as child:
        for answer in child.messages(_TIMEOUT_S):
            if answer is not None:
                return answer
        return {"kind": "its process", "text": child.last_words()}


def _main(arguments: Sequence[str]) -> None:
    parent = Parent()
    try:
        parent.send(names=_names(*arguments))
    except Exception as error:
        kind, name = type(error).__name__, getattr(error, "name", None)
        parent.send(kind=kind, text=str(error), name=name)


def _names(framework: str, what: str) -> list[str]:
    if framework == _SUITE:
        from dm_control import suite

        tasks = suite.ALL_TASKS if what == "all" else getattr(suite, what.upper())
        return sorted(f"dm_control/{domain}-{task}" for domain, task in tasks)
    from gymnasium.envs import registration

    if not what:
        return list(registration.registry)
    # The module may be in the working directory, like a policy's.
    sys.path.append(os.getcwd())  # noqa: PTH109  sys.path holds strings
    found = _ids_registered_by(what)
    # Gymnasium has already loaded its own modules, so their entry points are compared.
    below = (f"{what}.", f"{what}:")
    return [
        env_id
        for env_id, spec in registration.registry.items()
        if env_id in found or f"{spec.entry_point}".startswith(below)
    ]


def _ids_registered_by(module: str) -> set[str]:
    """Import a module, and return the ids that it registers itself."""
    import gymnasium
    from gymnasium.envs import registration

    registered: set[str] = set()
    register = registration.register

    def noting(*args: Any, **kwargs: Any) -> None:
        before = dict(registration.registry)
        register(*args, **kwargs)
        # Ignore ids that other modules register while they are imported.
        if f"{_module_being_imported()}.".startswith(f"{module}."):
            after = registration.registry.items()
            registered.update(key for key, spec in after if before.get(key) is not spec)

    gymnasium.register = registration.register = noting
    importlib.import_module(module)
    return registered


def _module_being_imported() -> str:
    frame: FrameType | None = sys._getframe()
    while frame is not None and frame.f_code.co_name != "<module>":
        frame = frame.f_back
    return "" if frame is None else str(frame.f_globals.get("__name__"))


if __name__ == "__main__":
    _main(sys.argv[1:])

# SPDX-License-Identifier: Apache-2.0
"""The names of the environments that are installed, for sets of tasks and patterns.

Frameworks are asked in a process of their own, `python -m
mjrec.environments.known_names`: dm_control chooses its way of drawing when it is
imported, and what only wants to know names shall not choose for its process.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence
from typing import Any

from ..child_python import Child, Parent
from ..errors import EnvironmentNotMade
from .dm_control_failures import dm_control_failure

_SUITE = "dm_control"
_GYMNASIUM = "gymnasium"

# The tasks of `lqr` and the like are slow to import on a busy machine; more is a hang.
_TIMEOUT_S = 300


def suite_tasks(tag: str) -> tuple[str, ...]:
    """Return the names `dm_control/<domain>-<task>` of a part of the suite, sorted.

    Args:
        tag: `benchmarking`, `easy`, `hard`, `extra`, or `all`.

    Raises:
        MissingDependency: dm_control is not installed, or does not work with this
            mujoco.
        EnvironmentNotMade: importing it failed otherwise.
    """
    said = _ask(_SUITE, tag)
    if "names" in said:
        return tuple(said["names"])
    raise dm_control_failure(f"dm_control:{tag}", _as_raised(said))


def gymnasium_ids(module: str | None = None) -> tuple[str, ...]:
    """Return the ids in Gymnasium's registry.

    Args:
        module: imported first, because it registers environments.

    Raises:
        EnvironmentNotMade: the module cannot be imported.
    """
    said = _ask(_GYMNASIUM, module or "")
    if "names" in said:
        return tuple(said["names"])
    raise EnvironmentNotMade(
        f"{module}:" if module else "the list of Gymnasium's environments",
        f"importing gave {said.get('kind')}: {said.get('text')}",
        hint="It must be installed, or lie in the working directory.",
    )


def mujoco_ids() -> tuple[str, ...]:
    """Return the ids of Gymnasium's own MuJoCo environments, the newest of each."""
    newest: dict[str, int] = {}
    for env_id in _names_of("mujoco"):
        name, _, version = env_id.rpartition("-v")
        newest[name] = max(int(version), newest.get(name, 0))
    return tuple(f"{name}-v{version}" for name, version in newest.items())


def _names_of(part: str) -> tuple[str, ...]:
    said = _ask(_GYMNASIUM, "", part)
    names: list[str] = said.get("names", [])
    return tuple(names)


def _ask(*arguments: str) -> dict[str, Any]:
    """Return what a process says of itself: `names`, or the error's `kind`, `text`."""
    # Names need no OpenGL; without a display, GLFW would complain.
    environ = {**os.environ, "MUJOCO_GL": "disabled"}
    with Child(__name__, *arguments, environ=environ) as child:
        for said in child.messages(_TIMEOUT_S):
            if said is not None:
                return said
        return {"kind": "its process", "text": child.last_words()}


def _as_raised(said: dict[str, Any]) -> Exception:
    """Return an error like the one that the process met."""
    text = str(said.get("text"))
    if said.get("kind") == ModuleNotFoundError.__name__:
        return ModuleNotFoundError(text, name=said.get("name"))
    return ImportError(text)


def _main(arguments: Sequence[str]) -> None:
    parent = Parent()
    try:
        parent.send(names=_names(*arguments))
    except Exception as error:
        kind, name = type(error).__name__, getattr(error, "name", None)
        parent.send(kind=kind, text=str(error), name=name)


def _names(framework: str, what: str, part: str = "") -> list[str]:
    if framework == _SUITE:
        return _suite_names(what)
    from gymnasium.envs import registration

    if what:
        # The working directory may hold it, as it may hold a policy.
        sys.path.append(os.getcwd())  # noqa: PTH109  sys.path holds texts
        importlib.import_module(what)
    known = registration.registry.values()
    inside = re.compile(rf"gymnasium\.envs\.{part}\." if part else "")
    return [spec.id for spec in known if inside.match(str(spec.entry_point))]


def _suite_names(tag: str) -> list[str]:
    from dm_control import suite

    tasks = suite.ALL_TASKS if tag == "all" else getattr(suite, tag.upper())
    return sorted(f"dm_control/{domain}-{task}" for domain, task in tasks)


if __name__ == "__main__":
    _main(sys.argv[1:])

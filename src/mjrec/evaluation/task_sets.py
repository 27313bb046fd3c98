# SPDX-License-Identifier: Apache-2.0
"""User-specified task names: environments, sets of environments and patterns.

======================  ==============================================================
`HalfCheetah-v5`        an environment as in `mjrec record`: a Gymnasium id,
                        `dm_control/<domain>-<task>`, or the path of an MJCF file;
                        an id without a version means the newest version
`dm_control:all`        a set; see `TASK_SETS`
`dm_control/walker-*`   a pattern with `*`, `?` and `[...]`, matched against the tasks
                        of the dm_control suite and the ids in Gymnasium's registry; a
                        pattern without a version (`Half*`) matches only the newest
                        version of each environment
`module:Fetch*-v4`      a pattern matched against the ids that this module registers
======================  ==============================================================
"""

from __future__ import annotations

import contextlib
import fnmatch
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from ..environments.known_names import (
    gymnasium_ids,
    mujoco_ids,
    newest_versions,
    suite_tasks,
    version_of,
)
from ..environments.names import parse_environment_name
from ..errors import InvalidArgument, MissingDependency, UnknownName

TASK_SETS: Mapping[str, Callable[[], Sequence[str]]] = {
    "dm_control:all": partial(suite_tasks, "all"),
    "dm_control:benchmarking": partial(suite_tasks, "benchmarking"),
    "dm_control:easy": partial(suite_tasks, "easy"),
    "dm_control:extra": partial(suite_tasks, "extra"),
    "dm_control:hard": partial(suite_tasks, "hard"),
    "gymnasium:mujoco": mujoco_ids,
}

_SUITE = "dm_control/"
_WILD = re.compile(r"[*?\[]")


def tasks_from(texts: Sequence[str]) -> tuple[str, ...]:
    """Return the environments named by the strings, in order, without duplicates.

    Raises:
        UnknownName: a set or file does not exist, or nothing matches a pattern.
        InvalidArgument: `texts` is empty, or a name is invalid.
        MissingDependency: the framework of a set is not installed.
        EnvironmentNotMade: the framework of a set cannot be imported.
    """
    if isinstance(texts, str):
        texts = [texts]
    tasks = dict.fromkeys(name for text in texts for name in _named(text))
    if not tasks:
        raise InvalidArgument(
            "An evaluation needs a task: an environment as in `mjrec record` "
            f"(dm_control/walker-walk), or a set: {', '.join(TASK_SETS)}."
        )
    return tuple(tasks)


def _named(text: str) -> Sequence[str]:
    if text in TASK_SETS:
        return TASK_SETS[text]()
    if _is_set(text):
        raise UnknownName(
            "set of tasks",
            text,
            TASK_SETS,
            hint="Tasks in the suite are named dm_control/<domain>-<task>.",
        )
    # The name of a file may contain brackets.
    if _WILD.search(text) and not Path(text).expanduser().is_file():
        return _matching(text)
    framework = parse_environment_name(text).framework
    if framework != "gymnasium" or version_of(text) >= 0:
        return [text]
    module, colon, env_id = text.rpartition(":")
    # If the id is unknown, the error from creating the environment lists known ids.
    newest = newest_versions(gymnasium_ids(module)).get(env_id, env_id)
    return [f"{module}{colon}{newest}"]


def _is_set(text: str) -> bool:
    """Return whether a name can only be a set."""
    framework, colon, name = text.partition(":")
    if not colon or _WILD.search(name):
        return False
    # `gymnasium:Ant-v5` is not a set. It names an environment and the module that
    # registers it.
    return framework == "dm_control" or (
        framework == "gymnasium" and version_of(name) < 0
    )


def _matching(pattern: str) -> Sequence[str]:
    module, colon, wanted = pattern.rpartition(":")
    known = list(_candidates(module, wanted))
    newest = newest_versions(known)
    matching = [newest[name] for name in newest if fnmatch.fnmatchcase(name, wanted)]
    # If nothing matches without versions, the pattern must include a version.
    matching = matching or [n for n in known if fnmatch.fnmatchcase(n, wanted)]
    if not matching:
        raise UnknownName(
            "task that matches",
            pattern,
            known,
            hint="Patterns are matched against the tasks of the dm_control suite, if "
            "it is installed, and the ids in Gymnasium's registry. The sets are "
            f"{', '.join(TASK_SETS)}.",
        )
    return [f"{module}{colon}{name}" for name in matching]


def _candidates(module: str, wanted: str) -> Iterator[str]:
    beginning = _WILD.split(wanted, maxsplit=1)[0]
    if not module and beginning.startswith(_SUITE):
        yield from suite_tasks("all")
        return
    if not module and _SUITE.startswith(beginning):
        # Not an error, because the pattern may be for other environments.
        with contextlib.suppress(MissingDependency):
            yield from suite_tasks("all")
    yield from gymnasium_ids(module)

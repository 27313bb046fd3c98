# SPDX-License-Identifier: Apache-2.0
"""The names of environments, and imports of user-specified modules."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import InvalidArgument, UnknownName

_DM_CONTROL = "dm_control/"
_MJCF_SUFFIXES = (".xml", ".mjcf")


@dataclass(frozen=True)
class EnvironmentName:
    """A parsed environment name.

    Attributes:
        framework: `"gymnasium"`, `"dm_control"` or `"mjcf"`.
        text: an id in any form that `gymnasium.make` accepts, including `module:Id`; a
            task, `dm_control/<domain>-<task>`; or the path of an MJCF file.
    """

    framework: str
    text: str


def parse_environment_name(text: str) -> EnvironmentName:
    """Parse an environment's name, without checking that it can be created.

    `dm_control/<domain>-<task>` is a task of the dm_control suite. A name that ends in
    `.xml` or `.mjcf` is a file, which must exist. Everything else is a Gymnasium id.

    Raises:
        UnknownName: the file does not exist.
        InvalidArgument: the name is empty, lacks a task, or refers to another type of
            file.
    """
    if not text.strip():
        raise InvalidArgument(
            "An environment's name must be a Gymnasium id (HalfCheetah-v5), "
            "dm_control/<domain>-<task> (dm_control/cheetah-run) or the path of an "
            "MJCF file (robot.xml), not empty."
        )
    if text.startswith(_DM_CONTROL):
        task_of_suite(text)
        return EnvironmentName("dm_control", text)
    path = Path(text).expanduser()
    is_mjcf = path.suffix.lower() in _MJCF_SUFFIXES
    if is_mjcf and not path.is_file():
        folder = path.parent
        there = sorted(p for p in folder.glob("*") if p.is_file())
        raise UnknownName(
            "MJCF file",
            str(path),
            [str(p) for p in there if p.suffix.lower() in _MJCF_SUFFIXES],
            hint=f"Looked in {folder.absolute()}.",
        )
    if is_mjcf:
        return EnvironmentName("mjcf", str(path))
    if path.is_file():
        raise InvalidArgument(
            f"{text} is a file, but an MJCF file's name must end in .xml or .mjcf."
        )
    return EnvironmentName("gymnasium", text)


def task_of_suite(name: str) -> tuple[str, str]:
    """Return the domain and the task from `dm_control/<domain>-<task>`.

    Raises:
        InvalidArgument: the name has no task.
    """
    # Domains and tasks are Python names, with underscores but without hyphens.
    domain, _, task = name.removeprefix(_DM_CONTROL).partition("-")
    if not (domain and task):
        raise InvalidArgument(
            "A dm_control environment's name must be dm_control/<domain>-<task>, for "
            f"example dm_control/cheetah-run, not {name!r}."
        )
    return domain, task


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Make modules in the working directory importable, ahead of installed modules."""
    directory = str(Path.cwd())
    sys.path.insert(0, directory)
    try:
        yield
    finally:
        # The imported code may have changed the list.
        with contextlib.suppress(ValueError):
            sys.path.remove(directory)

# SPDX-License-Identifier: Apache-2.0
"""The three kinds of environment names, and imports of modules that users name."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from ..errors import InvalidArgument, UnknownName

_DM_CONTROL = "dm_control/"
_MJCF_SUFFIXES = (".xml", ".mjcf")


@dataclass(frozen=True)
class GymnasiumName:
    """An environment in Gymnasium's registry.

    Attributes:
        env_id: the id, in any form that `gymnasium.make` takes, including `module:Id`.
    """

    env_id: str

    def __str__(self) -> str:
        return self.env_id


@dataclass(frozen=True)
class DmControlName:
    """A task of the dm_control suite.

    Attributes:
        domain: for example `humanoid_CMU`.
        task: for example `run`.
    """

    domain: str
    task: str

    def __str__(self) -> str:
        return f"{_DM_CONTROL}{self.domain}-{self.task}"


@dataclass(frozen=True)
class MjcfName:
    """A model in a file.

    Attributes:
        path: the MJCF file.
    """

    path: Path

    def __str__(self) -> str:
        return str(self.path)


EnvironmentName: TypeAlias = GymnasiumName | DmControlName | MjcfName


def parse_environment_name(text: str) -> EnvironmentName:
    """Parse an environment's name, without checking that it can be created.

    `dm_control/<domain>-<task>` is a task of the dm_control suite. A name that ends in
    `.xml` or `.mjcf` is a file, which must exist. Everything else is a Gymnasium id.

    Raises:
        UnknownName: the file does not exist.
        InvalidArgument: the name is empty, lacks its task, or names another type of
            file.
    """
    if not text.strip():
        raise InvalidArgument(
            "An environment's name must be a Gymnasium id (HalfCheetah-v5), "
            "dm_control/<domain>-<task> (dm_control/cheetah-run) or the path of an "
            "MJCF file (robot.xml). It is empty."
        )
    if text.startswith(_DM_CONTROL):
        return _dm_control_name(text)
    path = Path(text).expanduser()
    if path.suffix.lower() in _MJCF_SUFFIXES:
        return _mjcf_name(path)
    if path.is_file():
        raise InvalidArgument(
            f"{text} is a file, but an MJCF file's name must end in .xml or .mjcf."
        )
    return GymnasiumName(text)


def _dm_control_name(text: str) -> DmControlName:
    # Domains and tasks are Python names, with underscores but without hyphens.
    domain, hyphen, task = text.removeprefix(_DM_CONTROL).partition("-")
    if not (domain and hyphen and task):
        raise InvalidArgument(
            "A dm_control environment's name must be dm_control/<domain>-<task>, for "
            f"example dm_control/cheetah-run, not {text!r}."
        )
    return DmControlName(domain, task)


def _mjcf_name(path: Path) -> MjcfName:
    if path.is_file():
        return MjcfName(path)
    folder = path.parent
    there = sorted(folder.iterdir()) if folder.is_dir() else []
    raise UnknownName(
        "MJCF file",
        str(path),
        [str(p) for p in there if p.suffix.lower() in _MJCF_SUFFIXES and p.is_file()],
        hint=f"Looked in {folder.absolute()}.",
    )


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Make modules in the working directory importable, ahead of installed modules."""
    directory = str(Path.cwd())
    sys.path.insert(0, directory)
    try:
        yield
    finally:
        # Imported code may itself have changed the list.
        with contextlib.suppress(ValueError):
            sys.path.remove(directory)

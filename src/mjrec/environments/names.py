# SPDX-License-Identifier: Apache-2.0
"""What a person names: environments in three ways, and modules nearby."""

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
        env_id: as `gymnasium.make` takes it, also `module:Id`.
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
        path: of the MJCF file.
    """

    path: Path

    def __str__(self) -> str:
        return str(self.path)


EnvironmentName: TypeAlias = GymnasiumName | DmControlName | MjcfName


def parse_environment_name(text: str) -> EnvironmentName:
    """Return what `text` names, without looking whether it can be made.

    `dm_control/<domain>-<task>` is a task of the dm_control suite; a name that ends in
    `.xml` or `.mjcf` is a file, which must be there; all else is a Gymnasium id.

    Raises:
        UnknownName: there is no such file.
        InvalidArgument: the name is empty, lacks its task, or is a file of another
            kind.
    """
    if not text.strip():
        raise InvalidArgument(
            "An environment needs a name: a Gymnasium id (HalfCheetah-v5), "
            "dm_control/<domain>-<task> (dm_control/cheetah-run) or the path of an "
            "MJCF file (robot.xml)."
        )
    if text.startswith(_DM_CONTROL):
        return _dm_control_name(text)
    path = Path(text).expanduser()
    if path.suffix.lower() in _MJCF_SUFFIXES:
        return _mjcf_name(path)
    if path.is_file():
        raise InvalidArgument(
            f"{text} is a file, and an MJCF file's name ends in .xml or .mjcf."
        )
    return GymnasiumName(text)


def _dm_control_name(text: str) -> DmControlName:
    # Domains and tasks are Python names: they have underscores and no hyphens.
    domain, hyphen, task = text.removeprefix(_DM_CONTROL).partition("-")
    if not (domain and hyphen and task):
        raise InvalidArgument(
            "A dm_control environment is named dm_control/<domain>-<task>, for "
            f"example dm_control/cheetah-run, got {text!r}."
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
    """Let modules in the working directory be imported, before installed ones."""
    directory = str(Path.cwd())
    sys.path.insert(0, directory)
    try:
        yield
    finally:
        # What was imported may have changed the list itself.
        with contextlib.suppress(ValueError):
            sys.path.remove(directory)

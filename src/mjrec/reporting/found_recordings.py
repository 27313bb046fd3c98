# SPDX-License-Identifier: Apache-2.0
"""What the directories are that a report is made of."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import InvalidArgument
from ..evaluation.results_files import is_evaluation
from ..results.monitor_files import MonitorFiles, monitors_of


@dataclass(frozen=True)
class FoundRecordings:
    """A directory that has recordings.

    Attributes:
        directory: its path, as it was given or below one that was given.
        is_evaluation: whether it is an evaluation's; else monitors wrote into it.
    """

    directory: Path
    is_evaluation: bool


def find_recordings(
    directories: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[FoundRecordings]:
    """Return the directories that have recordings, each once, in their order.

    A directory is that of an evaluation, or one that monitors wrote into, or a folder
    that has such directories directly in it.

    Raises:
        InvalidArgument: one has no recordings, or there is none of that name, or none
            was given.
    """
    if isinstance(directories, str | os.PathLike):
        directories = [directories]
    found: dict[str, FoundRecordings] = {}
    for directory in map(Path, directories):
        for recordings in _recordings_of(directory):
            found.setdefault(os.path.realpath(recordings.directory), recordings)
    if not found:
        raise InvalidArgument(
            "A report needs at least one directory with recordings: that of `mjrec "
            "evaluate` or `mjrec record`, or one that a Monitor wrote into."
        )
    return [*found.values()]


def _recordings_of(directory: Path) -> list[FoundRecordings]:
    if not directory.is_dir():
        what = "is a file" if directory.exists() else "is not there"
        raise InvalidArgument(
            f"{directory} {what}. Name the directory that `mjrec evaluate` or `mjrec "
            "record` wrote into (--out), or that a Monitor did."
        )
    try:
        own = _of_itself(directory)
        found = [own] if own is not None else [*_one_level_below(directory)]
    except OSError as error:
        raise InvalidArgument(
            f"{directory} cannot be looked into: {error.strerror}. Name one that this "
            "user may read."
        ) from error
    if not found:
        raise InvalidArgument(
            f"{directory} holds no recordings, and neither do the folders directly in "
            f"it. `mjrec record ENV --out {shlex.quote(str(directory))}` makes some; "
            "`mjrec evaluate` makes some of many episodes."
        )
    return found


def _of_itself(directory: Path) -> FoundRecordings | None:
    if is_evaluation(directory):
        return FoundRecordings(directory, True)
    if any(map(_has_episodes, monitors_of(directory))):
        return FoundRecordings(directory, False)
    return None


def _one_level_below(directory: Path) -> Iterator[FoundRecordings]:
    for below in sorted(directory.iterdir()):
        # A link may lead anywhere, also to what is in the folder itself.
        if below.is_dir() and not below.is_symlink():
            own = _of_itself(below)
            if own is not None:
                yield own


def _has_episodes(files: MonitorFiles) -> bool:
    return bool(files.manifest or files.stats or files.journal or files.videos)

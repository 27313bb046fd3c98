# SPDX-License-Identifier: Apache-2.0
"""Finding a directory's monitor files, and removing them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from ..errors import DirectoryInUse
from ..formats.locks import is_locked
from ..formats.monitor_directory import is_manifest, iter_monitor_files
from ..formats.second_names import is_called_like_second

logger = logging.getLogger(__name__)


def detect_training_manifests(
    directory: str | os.PathLike[str], files: Iterable[str] | None = None
) -> list[str]:
    """Return the paths of the manifests in `directory`, sorted.

    Unfinished manifests and files with names like a manifest's are left out. A
    directory that is not there has none.

    Args:
        directory: where to look; not below it.
        files: the names to choose from, instead of what the directory holds.
    """
    directory = Path(directory)
    if files is None:
        files = (path.name for path in iter_monitor_files(directory))
    return [str(directory / name) for name in sorted(files) if is_manifest(name)]


def detect_monitor_files(directory: str | os.PathLike[str]) -> list[str]:
    """Return the paths of all files in `directory` that monitors finished, sorted.

    Files that only begin like one (`openaigym.notes.txt`) are left out.
    """
    return [str(path) for path in iter_monitor_files(Path(directory))]


def clear_monitor_files(directory: str | os.PathLike[str]) -> None:
    """Remove the files of all monitors in `directory`, also unfinished ones.

    Also the second names of videos (`rl-video-episode-27.mp4`), where they lead to one
    of these files. Nothing else is removed: no directory, and no file that only begins
    like a monitor's.

    Raises:
        DirectoryInUse: a monitor that is still open writes there. Nothing was
            removed.
    """
    paths = list(iter_monitor_files(Path(directory), hidden=True))
    for path in paths:
        if path.suffix == ".lock" and is_locked(path):
            raise DirectoryInUse(
                f"Cannot clear {directory}: a monitor that is still open writes there "
                f"(it holds {path.name}). Close it first, or use another directory."
            )
    # Names that would lead nowhere first, then manifests and journals: if this is
    # interrupted, none lists what is gone.
    listings_first = sorted(paths, key=lambda path: not _is_listing(path.name))
    for path in (*_second_names(Path(directory), paths), *listings_first):
        path.unlink(missing_ok=True)
    logger.info("Removed %d monitor files from %s.", len(paths), directory)


def _second_names(directory: Path, paths: Iterable[Path]) -> list[Path]:
    """Return the other names in a directory of these files."""
    # What a monitor's file itself is a link to is somebody else's.
    files = {file for path in paths if (file := _file(path, follow=False))}
    return [
        path
        for path in (directory.iterdir() if files else ())
        if is_called_like_second(path.name) and _file(path, follow=True) in files
    ]


def _file(path: Path, *, follow: bool) -> tuple[int, int] | None:
    """Return which file a name leads to; None where it leads to none."""
    try:
        stat = path.stat(follow_symlinks=follow)
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _is_listing(name: str) -> bool:
    return is_manifest(name) or name.endswith(".jsonl")

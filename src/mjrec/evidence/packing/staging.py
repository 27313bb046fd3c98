# SPDX-License-Identifier: Apache-2.0
"""A hidden folder beside the archive, in which it is put together.

Files get there as hard links where that is possible, so that a run of many gigabytes
needs little room. Nothing there is ever written in place: what is to become different
is written anew and renamed.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from ...atomic_files import temporary_path
from ...errors import DirectoryNotWritable, FileNotWritten, UnreadableFile
from ...formats.manifest import write_manifest
from .contents import Contents

# What a full disk calls for.
TRY_AGAIN = "then pack again"


@contextlib.contextmanager
def staging_folder(archive: Path) -> Iterator[Path]:
    """Yield a new hidden folder beside `archive`, and remove it at the end.

    Raises:
        DirectoryNotWritable: there can be none.
    """
    folder = temporary_path(archive)
    try:
        folder.mkdir(mode=0o700)
    except OSError as error:
        raise DirectoryNotWritable(archive.parent, error.strerror) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def stage(contents: Contents, folder: Path) -> None:
    """Put what is to be packed into a new folder.

    Raises:
        FileNotWritten: the disk is full.
        UnreadableFile: a file cannot be read, or is no regular file any more.
    """
    folder.mkdir()
    for name, path in contents.files.items():
        _link_or_copy(path, folder / name)
    for name, manifest in contents.manifests.items():
        write_manifest(folder / name, manifest)


def copy_folder(source: Path, target: Path) -> None:
    """Put the files of a folder, which has none in it, into a new one.

    Raises:
        FileNotWritten, UnreadableFile: as `stage`.
    """
    target.mkdir(parents=True)
    for path in sorted(source.iterdir()):
        _link_or_copy(path, target / path.name)


def publish(finished: Path, path: Path) -> None:
    """Give a finished archive its name, and replace nothing.

    Raises:
        FileExistsError: somebody has put something there meanwhile.
        FileNotWritten: it cannot be called that.
    """
    try:
        path.hardlink_to(finished)
    except FileExistsError:
        raise
    except OSError:
        # A file system without links: the moment between look and renaming stays.
        if os.path.lexists(path):
            raise FileExistsError(path) from None
        try:
            finished.rename(path)
        except OSError as error:
            raise FileNotWritten(path, error.strerror, then=TRY_AGAIN) from error


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        # Another file system, one without links, or somebody else's file.
        _copy(source, target)
    if not stat.S_ISREG(target.lstat().st_mode):
        raise UnreadableFile(source, "it is no regular file any more")
    if not os.access(target, os.R_OK):
        raise UnreadableFile(source, "permission denied")


def _copy(source: Path, target: Path) -> None:
    try:
        file = source.open("rb")
    except OSError as error:
        raise UnreadableFile(source, error.strerror) from error
    try:
        with file, target.open("xb") as copy:
            shutil.copyfileobj(file, copy)
    except OSError as error:
        raise FileNotWritten(target, error.strerror, then=TRY_AGAIN) from error

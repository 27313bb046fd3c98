# SPDX-License-Identifier: Apache-2.0
"""A folder as a zip file that depends on the names and contents of its files alone.

Times, modes, owners, the order of the directory and the name of the machine are left
out. What is compressed already is stored, which also makes it quick; the rest is
deflated, so the same zlib gives the same bytes.
"""

from __future__ import annotations

import os
import shutil
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

from ...errors import FileNotWritten
from .staging import TRY_AGAIN

# The endings of files in which nothing is left to be compressed.
STORED = (".mp4", ".avi", ".h5", ".gz", ".zip")

_LEVEL = 6
_UNIX = 3
_MODE = (stat.S_IFREG | 0o644) << 16
# The first moment that a zip file can name.
_TIME = (1980, 1, 1, 0, 0, 0)
_BLOCK = 1 << 20


def write_zip(
    folder: Path, path: Path, *, on_file: Callable[[], object] = lambda: None
) -> None:
    """Write all files of a folder, which becomes the archive's only top folder.

    The file is on the disk when this returns.

    Args:
        folder: what to pack.
        path: the archive; it must not exist.
        on_file: called after each file.

    Raises:
        FileNotWritten: the disk is full.
    """
    try:
        with (
            path.open("xb") as file,
            zipfile.ZipFile(file, "w", strict_timestamps=True) as archive,
        ):
            for source in _files(folder):
                name = source.relative_to(folder.parent).as_posix()
                _add(archive, source, name)
                on_file()
        _to_disk(path)
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error, then=TRY_AGAIN) from error


def _files(folder: Path) -> list[Path]:
    found = (path for path in folder.rglob("*") if not path.is_dir())
    # By the names as they are in the archive, whatever the system's own order.
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _add(archive: zipfile.ZipFile, source: Path, name: str) -> None:
    info = zipfile.ZipInfo(name, _TIME)
    info.create_system = _UNIX
    info.external_attr = _MODE
    info.file_size = source.stat().st_size
    stored = source.name.endswith(STORED)
    info.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
    # Public only from Python 3.13 on, as `compress_level`; `open` reads it in all.
    info._compresslevel = None if stored else _LEVEL  # type: ignore[attr-defined]  # see above
    with source.open("rb") as file, archive.open(info, "w") as entry:
        shutil.copyfileobj(file, entry, _BLOCK)


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

# SPDX-License-Identifier: Apache-2.0
"""Unpacking a zip file that may be anybody's, into a folder of one's own."""

from __future__ import annotations

import shutil
import zipfile
import zlib
from pathlib import Path
from typing import IO

from ...errors import Error, FileNotWritten, UnreadableArchive
from ...formats.regular_files import open_regular
from .portable_names import portable_parts
from .zip_contents import ZipContents, check_table, zip_contents

_CHUNK = 1 << 20
# What else is on a disk that is nearly full must go on.
_ROOM = 1 << 26


def unpack(path: Path, into: Path) -> Path:
    """Unpack a zip file, and return its one folder.

    Everything is streamed to the disk, and counted while it is: an archive that holds
    more than it says is refused at the first byte too many.

    Args:
        path: of the archive.
        into: a folder that is there, empty, and nobody else's.

    Raises:
        UnreadableArchive: it is damaged, no plain archive, or made to do harm.
        Error: there is too little room in `into`.
    """
    try:
        check_table(path)
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            contents = zip_contents(archive)
            _check_room(contents, into, path)
            _write_all(archive, contents, into)
    except FileNotWritten:
        raise
    except OSError as error:
        raise UnreadableArchive(path, error.strerror or error) from error
    except _NOT_READ as error:
        raise UnreadableArchive(path, error) from error
    return into / contents.top


# zipfile raises RuntimeError for an encrypted file, NotImplementedError for methods and
# versions that it does not know.
_NOT_READ = (
    *(ValueError, zipfile.BadZipFile, zlib.error, EOFError),
    *(RuntimeError, NotImplementedError, MemoryError),
)


def _check_room(contents: ZipContents, into: Path, path: Path) -> None:
    free = shutil.disk_usage(into).free
    if contents.size + _ROOM > free:
        raise Error(
            f"Unpacking {path} takes {contents.size} bytes, and {free} are free in "
            f"{into.parent}. Choose another disk with the variable TMPDIR, or unpack "
            "it yourself and verify the folder."
        )


def _write_all(archive: zipfile.ZipFile, contents: ZipContents, into: Path) -> None:
    for name in contents.folders:
        into.joinpath(*portable_parts(name.removesuffix("/"))).mkdir(
            parents=True, exist_ok=True
        )
    for info in contents.files:
        target = into.joinpath(*portable_parts(info.filename))
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            output = target.open("xb")
        except OSError as error:
            raise FileNotWritten(target, error.strerror) from error
        with archive.open(info) as packed, output:
            _copy(packed, output, target, info.file_size)


def _copy(packed: IO[bytes], output: IO[bytes], target: Path, size: int) -> None:
    """Copy a file of exactly `size` bytes."""
    left = size
    while chunk := packed.read(_CHUNK):
        left -= len(chunk)
        if left < 0:
            break
        try:
            output.write(chunk)
        except OSError as error:
            raise FileNotWritten(target, error.strerror) from error
    if left:
        raise ValueError(f"{target.name!r} has another size than it is said to have")

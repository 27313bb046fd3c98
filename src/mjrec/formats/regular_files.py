# SPDX-License-Identifier: Apache-2.0
"""Functions that open files in an untrusted directory.

A file with a monitor file's name may be a pipe, which blocks when it is opened. It may
be a device, which may do anything, or a link to a private file of the user who reads
the directory. Only regular files are opened, and links are followed only inside their
directory, so that nothing from elsewhere is read, packed or rendered.
"""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

# If a link or a pipe replaces the file after the check, do not follow or wait for it.
_CAREFULLY = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY


def regular_path(path: Path) -> Path:
    """Return the path of a regular file, after following a link.

    Raises:
        OSError: the file does not exist.
        ValueError: the path is not a regular file, or is a link that leads out of its
            directory.
    """
    if path.is_symlink():
        # Not `Path.resolve`, which does not raise an OSError for a link to itself.
        target = Path(os.path.realpath(path, strict=True))
        if not target.is_relative_to(os.path.realpath(path.parent)):
            raise ValueError(
                "it is a link that leads out of its directory: replace it with the "
                "file itself"
            )
        path = target
    if not stat.S_ISREG(path.lstat().st_mode):
        raise ValueError("it is not a regular file")
    return path


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading bytes.

    Raises:
        OSError: the file cannot be opened.
        ValueError: see `regular_path`.
    """
    descriptor = os.open(regular_path(path), _CAREFULLY)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError("it is not a regular file")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: Path, *, limit: int) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is larger than `limit`, or see `regular_path`.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise ValueError(f"it has {size} bytes, more than the limit of {limit}")
        return file.read(size)

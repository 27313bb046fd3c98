# SPDX-License-Identifier: Apache-2.0
"""Opening files that a stranger may have put into a directory.

What bears a monitor file's name may be a pipe, whose opening waits for ever, a device,
which may do anything when it is opened, or a link to a file of the user who reads the
directory. Only regular files are opened, and links are followed only inside their
directory: what is read, packed or rendered never comes from elsewhere.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

# Whatever is put there between the look and the opening is not followed or waited for.
_CAREFULLY = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY


def regular_path(path: Path) -> Path:
    """Return the path of the regular file that `path` is, or is a link to.

    Raises:
        OSError: there is no such file.
        ValueError: it is no regular file, or a link that leads out of its directory.
    """
    if path.is_symlink():
        path = _followed(path)
    if not stat.S_ISREG(path.lstat().st_mode):
        raise ValueError("it is not a regular file")
    return path


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading bytes.

    Raises:
        OSError: it cannot be opened.
        ValueError: as `regular_path`.
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
    """Return all of a regular file of at most `limit` bytes.

    Raises:
        OSError: it cannot be read.
        ValueError: as `regular_path`, or it is larger.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise ValueError(f"it has {size} bytes, and {limit} would be much")
        return file.read(size)


def _followed(link: Path) -> Path:
    # Not `Path.resolve`: what that raises for a link to itself is no OSError.
    target = Path(os.path.realpath(link, strict=True))
    if not target.is_relative_to(os.path.realpath(link.parent)):
        raise ValueError(
            "it is a link that leads out of its directory; put the file itself there"
        )
    return target

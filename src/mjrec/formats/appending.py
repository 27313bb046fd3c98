# SPDX-License-Identifier: Apache-2.0
"""Files that grow by whole pieces, each with the operating system at once.

A line of a journal, a row of a table, a record of TensorBoard's:
half a piece would be taken for another one, and hide what is behind it. What is added
outlives the process that added it.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path


def open_for_appending(path: Path, *, new: bool = False) -> int:
    """Return a descriptor for `append_whole` of a file that is made if need be.

    Args:
        path: the file.
        new: it must not be there.

    Raises:
        OSError: it cannot be opened, or is a link.
    """
    flags = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CREAT
    return os.open(path, flags | os.O_EXCL * new, 0o666)


def append_whole(descriptor: int, piece: bytes, *, torn: bytes = b"") -> None:
    """Add a piece to a file, whole or not at all.

    Args:
        descriptor: of `open_for_appending`.
        piece: what to add.
        torn: comes before it where the file does not end with a line feed, because its
            writer was killed in the middle of a line.

    Raises:
        OSError: the disk is full, and the file is as it was before; or it was removed.
    """
    status = os.fstat(descriptor)
    if status.st_nlink == 0:
        # What is written there is nowhere.
        raise FileNotFoundError(errno.ENOENT, "it was removed while it was written")
    if torn and status.st_size:
        is_torn = os.pread(descriptor, 1, status.st_size - 1) != b"\n"
        piece = torn * is_torn + piece
    written = os.write(descriptor, piece)
    if written != len(piece):
        # Half a piece; where another one follows, it stays and is passed over.
        end = os.lseek(descriptor, 0, os.SEEK_CUR)
        if os.fstat(descriptor).st_size == end:
            os.ftruncate(descriptor, end - written)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

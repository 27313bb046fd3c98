# SPDX-License-Identifier: Apache-2.0
"""New files to which only complete pieces are appended."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ..atomic_files import (
    append_whole,
    make_directory,
    open_for_appending,
    writing,
)
from ..errors import DirectoryNotWritable


class AppendOnlyFile:
    """A new file to which whole pieces are appended immediately.

    A piece is appended completely or not at all, because half a row would be read as a
    different row, and nothing after half a record would be read. Appended pieces
    survive the end of this process.

    Args:
        names: candidate paths, which may come from an iterator. The first path that
            does not exist is created, together with its directory.

    Raises:
        DirectoryNotWritable: the directory cannot be created or written to.

    Attributes:
        path: the file.
    """

    def __init__(self, names: Iterable[Path]) -> None:
        for path in names:
            make_directory(path.parent)
            try:
                self._file = os.fdopen(open_for_appending(path, new=True), "ab", 0)
            except FileExistsError:
                continue
            except OSError as error:
                raise DirectoryNotWritable(path.parent, error.strerror) from error
            self.path = path
            return
        raise ValueError("names must contain a name that is not in use")

    def append(self, piece: bytes) -> None:
        """Append `piece`.

        Raises:
            FileNotWritten: the disk has no room for the piece. The file is unchanged.
        """
        with writing(self.path):
            append_whole(self._file.fileno(), piece)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

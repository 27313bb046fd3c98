# SPDX-License-Identifier: Apache-2.0
"""New files that grow by whole pieces."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ..errors import DirectoryNotWritable, FileNotWritten
from ..formats.appending import append_whole, open_for_appending


class AppendOnlyFile:
    """A new file, to which a piece is added whole or not at all, and at once.

    Half a row would be read as another one, and nothing behind half a record would be
    read. What is added outlives this process.

    Args:
        names: of these, the first that is not there yet; each is given once.
            Their directory is made.

    Raises:
        DirectoryNotWritable: the directory cannot be made or written to.

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
        raise ValueError("names must hold a free one")

    def append(self, piece: bytes) -> None:
        """Add `piece`.

        Raises:
            FileNotWritten: it has no room; the file is as it was before.
        """
        try:
            append_whole(self._file.fileno(), piece)
        except OSError as error:
            raise FileNotWritten(self.path, error.strerror) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def make_directory(directory: Path) -> None:
    """Make a directory, and those above it, where they are not there.

    Raises:
        DirectoryNotWritable: it cannot be made.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error

# SPDX-License-Identifier: Apache-2.0
"""Atomic writes: a file, or a piece appended to one, appears whole or not at all.

A file is written under a temporary name in its own directory and then renamed, so an
incomplete file never has the final name. The temporary name starts with a dot and ends
in `.part`: `.<name>.<8 hex digits>.part`.

An appended piece is a line of a journal, a row of a table or a TensorBoard record. An
incomplete piece would corrupt the next one. Appended data survives the death of the
process that wrote it.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

from .errors import DirectoryNotWritable, FileNotWritten


def temporary_path(path: Path) -> Path:
    """Return a new temporary name for `path`, in the same directory.

    The name starts with exactly one dot, even if `path` itself is hidden. Programs that
    clean up a directory recognize temporary files by that dot.
    """
    name = path.name.removeprefix(".")
    return path.with_name(f".{name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def writing(path: Path, **advice: str) -> Iterator[None]:
    """Convert any `OSError` raised in the block to `FileNotWritten`.

    Args:
        path: the file that the block writes.
        **advice: `then`, if `FileNotWritten` should give different advice.
    """
    try:
        yield
    except FileNotWritten:
        raise
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error, **advice) from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path; rename it to `path` at the end of the block.

    If the block raises, the temporary file is removed and `path` is unchanged.
    """
    temporary = temporary_path(path)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Replace the content of `path` with `text`, encoded as UTF-8.

    Raises:
        FileNotWritten: the disk is full, or the directory is missing or read-only.
    """
    with writing(path), replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def make_directory(directory: Path) -> None:
    """Create a directory and its parents, if they do not exist.

    Raises:
        DirectoryNotWritable: the directory cannot be created.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error


def open_for_appending(path: Path, *, new: bool = False) -> int:
    """Open a file for `append_whole`, creating it if necessary.

    Args:
        path: the file.
        new: whether to fail if the file already exists.

    Returns:
        A file descriptor.

    Raises:
        OSError: the file cannot be opened, or is a link.
    """
    flags = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CREAT
    return os.open(path, flags | os.O_EXCL * new, 0o666)


def append_whole(descriptor: int, piece: bytes, *, torn: bytes = b"") -> None:
    """Append a piece to a file: either the whole piece or nothing.

    Args:
        descriptor: a descriptor from `open_for_appending`.
        piece: the bytes to append.
        torn: bytes to write before the piece if the file does not end with a line feed
            (because its last writer was killed in the middle of a line).

    Raises:
        OSError: the disk is full (the file is then unchanged), or the file was removed.
    """
    status = os.fstat(descriptor)
    if status.st_nlink == 0:
        # The file has been deleted: anything written to it would be lost.
        raise FileNotFoundError(errno.ENOENT, "it was removed while being written")
    if torn and status.st_size:
        is_torn = os.pread(descriptor, 1, status.st_size - 1) != b"\n"
        piece = torn * is_torn + piece
    written = os.write(descriptor, piece)
    if written != len(piece):
        # The piece was written only in part. Remove that part, unless another piece
        # already follows it; readers will then skip it.
        end = os.lseek(descriptor, 0, os.SEEK_CUR)
        if os.fstat(descriptor).st_size == end:
            os.ftruncate(descriptor, end - written)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 digest of a file as a hex string."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class AppendOnlyFile:
    """A new file to which whole pieces are appended immediately.

    A piece is appended completely or not at all: a partial row would be read as a
    different row, and a partial record would make all later records unreadable.
    Appended pieces survive the end of this process.

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
        raise ValueError("names must contain a path that does not exist yet")

    def append(self, piece: bytes) -> None:
        """Append `piece`.

        Raises:
            FileNotWritten: the disk is full. The file is unchanged.
        """
        with writing(self.path):
            append_whole(self._file.fileno(), piece)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

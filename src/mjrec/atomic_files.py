# SPDX-License-Identifier: Apache-2.0
"""Atomic file writes: a file appears complete or not at all.

A file is written under a temporary name in its own directory and then renamed, so an
incomplete file never has the final name. The temporary name starts with a dot and ends
in `.part`: `.<name>.<8 hex digits>.part`.
"""

from __future__ import annotations

import contextlib
import hashlib
import secrets
from collections.abc import Iterator
from pathlib import Path

from .errors import DirectoryNotWritable, FileNotWritten


def temporary_path(path: Path) -> Path:
    """Return a new temporary name for `path`, in the same directory.

    The name starts with exactly one dot, even if `path` itself is hidden: programs that
    clean up a directory recognize the file by that dot.
    """
    name = path.name.removeprefix(".")
    return path.with_name(f".{name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def writing(path: Path, **advice: str) -> Iterator[None]:
    """Turn any other `OSError` in the block into `FileNotWritten`.

    Args:
        path: the file that the block writes.
        **advice: `then`, if `FileNotWritten` should give other advice.
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


def file_sha256(path: Path) -> str:
    """Return the SHA-256 digest of a file as a hex string."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all.

A file is written under a temporary name in its own directory and then renamed, so
that half of it never has its final name. The temporary name begins with
a dot and ends in `.part`: `.<name>.<8 hex digits>.part`.
"""

from __future__ import annotations

import contextlib
import hashlib
import secrets
from collections.abc import Iterator
from pathlib import Path

from .errors import FileNotWritten


def temporary_path(path: Path) -> Path:
    """Return a new name for an unfinished `path`, in the same directory.

    It is hidden by one dot, also where `path` is hidden itself: by that dot a program
    that puts a directory in order knows the file.
    """
    name = path.name.removeprefix(".")
    return path.with_name(f".{name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path; rename it to `path` at the end of the block.

    If the block raises, the temporary file is removed and `path` stays as it was.
    """
    temporary = temporary_path(path)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write `text`, in UTF-8, as the whole content of `path`.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone or read-only.
    """
    try:
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise FileNotWritten(path, error.strerror) from error


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

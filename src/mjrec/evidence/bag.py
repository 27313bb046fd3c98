# SPDX-License-Identifier: Apache-2.0
"""A folder as a BagIt bag (RFC 8493), and as a zip file of always the same bytes.

The files of the bag are written here, because `bagit.make_bag` writes version 0.97, in
the directory's own order, and changes the working directory of the whole process. The
`bagit` package, which knows nothing of this one, then validates the bag.

Of the zip file, times, modes, owners, order and machine are left out. What is
compressed already is stored; the rest is deflated, so that the same zlib gives the same
bytes.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import shutil
import stat
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten, MissingDependency, PackError
from .layout import PAYLOAD

# The endings of files in which nothing is left to be compressed.
STORED = (".mp4", ".avi", ".h5", ".gz", ".zip")
# What a full disk calls for.
TRY_AGAIN = "then pack again"

_ALGORITHM = "sha512"
_LEVEL = 6
_UNIX = 3
_MODE = (stat.S_IFREG | 0o644) << 16
# The first moment that a zip file can name.
_TIME = (1980, 1, 1, 0, 0, 0)
_BLOCK = 1 << 20


def check_bagit() -> None:
    """Check that the `bagit` package is there.

    Raises:
        MissingDependency: it is not.
    """
    if importlib.util.find_spec("bagit") is None:
        raise MissingDependency(
            "bagit", purpose="Packing a run", install='pip install "mjrec[evidence]"'
        )


def make_bag(folder: Path, info: Mapping[str, str]) -> None:
    """Make a bag of a folder, whose payload is in `data` already.

    Args:
        folder: the bag's.
        info: what `bag-info.txt` says, besides the payload's size.

    Raises:
        PackError: the `bagit` package does not take the bag for a valid one.
    """
    payload = _files(folder / PAYLOAD)
    size = sum(path.stat().st_size for path in payload)
    # Since 1.0 a percent sign in a name is written as %25, which the `bagit` package
    # and `sha512sum --check` do not know. Names of cameras may have one.
    version = "0.97" if any("%" in path.name for path in payload) else "1.0"
    tags = {**info, "Payload-Oxum": f"{size}.{len(payload)}"}
    _write_tags(
        folder / "bagit.txt",
        {"BagIt-Version": version, "Tag-File-Character-Encoding": "UTF-8"},
    )
    _write_tags(folder / "bag-info.txt", dict(sorted(tags.items())))
    _write_manifest(folder, "manifest", payload)
    _write_manifest(folder, "tagmanifest", sorted(folder.glob("*.txt")))
    # Optional, so it is not imported with this module; it has no types.
    bagit: Any = importlib.import_module("bagit")
    try:
        bagit.Bag(str(folder)).validate()
    except bagit.BagError as error:
        raise PackError(
            f"The bag that was made is not valid: {error}. A file has been changed "
            "while it was packed, or this is a mistake in mjrec."
        ) from error


def write_zip(folder: Path, path: Path) -> None:
    """Write all files of a folder, which becomes the archive's only top folder.

    The file is on the disk when this returns.

    Raises:
        FileNotWritten: the disk is full.
    """
    try:
        with path.open("xb") as file:
            with zipfile.ZipFile(file, "w") as archive:
                for source in _files(folder):
                    name = source.relative_to(folder.parent).as_posix()
                    _add(archive, source, name)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error, then=TRY_AGAIN) from error


def _files(folder: Path) -> list[Path]:
    found = (path for path in folder.rglob("*") if path.is_file())
    # By the names as they are in the archive, whatever the system's own order.
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _write_tags(path: Path, tags: Mapping[str, str]) -> None:
    _write_lines(path, (f"{key}: {value}" for key, value in tags.items()))


def _write_manifest(folder: Path, kind: str, files: Iterable[Path]) -> None:
    lines = (
        f"{_digest(path)}  {path.relative_to(folder).as_posix()}" for path in files
    )
    _write_lines(folder / f"{kind}-{_ALGORITHM}.txt", lines)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, _ALGORITHM).hexdigest()


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    path.write_text(text, encoding="utf-8", newline="\n")


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

# SPDX-License-Identifier: Apache-2.0
"""What is left of an identity in files, however it is packed there.

Archives are opened, compressed files are unpacked, and of HDF5 files every attribute,
name and dataset is looked at: as UTF-8, and as UTF-16 in both orders of bytes.
"""

from __future__ import annotations

import gzip
import io
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...errors import UnreadableFile
from ...formats.trajectory_hdf5 import SIGNATURE
from .identity import Identity
from .identity_matching import IdentityMatcher

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\3\4"
_FILM = re.compile(rb"....ftyp|RIFF....AVI ", re.DOTALL)
# An archive in an archive in an archive ...
_DEEPEST = 8
_PIECE = 1 << 24
_ROWS_AT_ONCE = 1 << 14
_LONGEST_NAME = 1 << 12

# Where something is, and what is there: a name, or bytes; and whether these may hold
# any few letters by chance.
_Place = tuple[str, str | bytes, bool]

_DAMAGE = (
    OSError,
    EOFError,
    RuntimeError,
    LookupError,
    ValueError,
    TypeError,
    zlib.error,
    zipfile.BadZipFile,
)


def remaining_identity(stage: Path, identity: Identity) -> list[tuple[str, str]]:
    """Return what names a person or a machine below a directory.

    Args:
        stage: the directory; its own name, and the path of it, do not count.
        identity: what to look for; how it is matched, `identity_matching` says.

    Returns:
        Where, and what: the name of a file relative to `stage`, followed by the place
        inside of it; and the text that was found there. Each once, sorted.

    Raises:
        UnreadableFile: something cannot be unpacked, so that nobody knows.
    """
    matcher = IdentityMatcher(identity)
    found: set[tuple[str, str]] = set()
    for path in sorted(stage.rglob("*")):
        where = path.relative_to(stage).as_posix()
        found.update((where, what) for what in matcher.found_in_name(path.name))
        if path.is_symlink():
            target = str(path.readlink())
            found.update((where, what) for what in matcher.found_in(target))
        elif path.is_file():
            found.update(_found_in_file(path, where, matcher))
    return sorted(found)


def _found_in_file(
    path: Path, where: str, matcher: IdentityMatcher
) -> Iterator[tuple[str, str]]:
    try:
        for place, something, by_chance in _places_in_file(path, where):
            if isinstance(something, str):
                whats = matcher.found_in_name(something)
            else:
                whats = matcher.found_in_bytes(something, by_chance=by_chance)
            yield from ((place, what) for what in whats)
    except _DAMAGE as error:
        raise UnreadableFile(path, f"it cannot be unpacked ({error})") from error


def _places_in_file(path: Path, where: str) -> Iterator[_Place]:
    with path.open("rb") as file:
        piece = file.read(_PIECE)
        if not _FILM.match(piece):
            yield from _places(where, piece + file.read(), 0)
            return
        # Films are large, and nothing in them is packed that could name anybody.
        while piece:
            following = file.read(_PIECE)
            yield where, piece + following[:_LONGEST_NAME], True
            piece = following


def _places(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    if depth > _DEEPEST:
        raise ValueError("it is packed in itself")
    if content.startswith(SIGNATURE):
        yield where, content, True
        yield from _places_in_hdf5(where, content)
    elif content.startswith(_ZIP):
        yield where, content, True
        yield from _places_in_zip(where, content, depth)
    elif content.startswith(_GZIP):
        # The header, in which the name of the file may be.
        yield where, content, True
        yield from _places(f"{where}, unpacked", gzip.decompress(content), depth + 1)
    else:
        yield where, content, False


def _places_in_zip(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        yield where, archive.comment, False
        for info in archive.infolist():
            inside = f"{where}: {info.filename}"
            yield inside, info.filename, False
            yield inside, info.comment + info.extra, False
            yield from _places(inside, archive.read(info), depth + 1)


def _places_in_hdf5(where: str, content: bytes) -> Iterator[_Place]:
    """Yield what is in an HDF5 file; a place in it is `/group/dataset@attribute`."""
    found: list[tuple[str, Any]] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(lambda name, item: found.append((name, item)))
        for name, item in [("", file), *found]:
            inside = f"{where}: /{name}"
            yield inside, name, False
            for key in item.attrs:
                yield inside, key, False
                yield from _values_in(f"{inside}@{key}", item.attrs[key])
            if isinstance(item, h5py.Dataset):
                for field in item.dtype.names or ():
                    yield inside, field, False
                yield from _rows_in(inside, item)


def _rows_in(where: str, dataset: Any) -> Iterator[_Place]:
    if not dataset.shape:
        yield from _values_in(where, dataset[()])
        return
    for start in range(0, dataset.shape[0], _ROWS_AT_ONCE):
        yield from _values_in(where, dataset[start : start + _ROWS_AT_ONCE])


def _values_in(where: str, value: Any) -> Iterator[_Place]:
    array = np.asarray(value)
    if array.dtype.kind not in "OUS":
        yield where, np.ascontiguousarray(array).tobytes(), True
        return
    for item in array.reshape(-1).tolist():
        text = item if isinstance(item, bytes) else str(item).encode(errors="replace")
        yield where, text, False

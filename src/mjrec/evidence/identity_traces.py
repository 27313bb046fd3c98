# SPDX-License-Identifier: Apache-2.0
"""Search for traces of an identity in files, including packed ones.

Archives are opened, compressed files are decompressed, and every name, attribute and
string in HDF5 files is checked.
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

from ..errors import UnreadableFile
from ..formats.trajectory_hdf5 import SIGNATURE
from .identity import Identity
from .identity_matching import IdentityMatcher

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\3\4"
_FILM = re.compile(rb"....ftyp|RIFF....AVI ", re.DOTALL)
# Maximum depth of archives inside archives.
_DEEPEST = 8
_PIECE = 1 << 24
_LONGEST_NAME = 1 << 12

# A place, its content (a name or bytes), and whether the bytes may contain short
# strings by chance.
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
    """Return the names of people and machines that remain below a directory.

    Args:
        stage: the directory; its own name and path are not searched.
        identity: the identity to look for; `identity_matching` lists the rules.

    Returns:
        Pairs of a place and the string found there, each once, sorted. A place is a
        file's path relative to `stage`, followed by the place inside the file.

    Raises:
        UnreadableFile: a file cannot be unpacked.
    """
    matcher = IdentityMatcher(identity)
    found: set[tuple[str, str]] = set()
    for path in sorted(stage.rglob("*")):
        where = path.relative_to(stage).as_posix()
        found.update((where, what) for what in matcher.found_in_name(path.name))
        if not path.is_file():
            continue
        try:
            for place, content, by_chance in _places_in_file(path, where):
                whats = (
                    matcher.found_in_name(content)
                    if isinstance(content, str)
                    else matcher.found_in_bytes(content, by_chance=by_chance)
                )
                found.update((place, what) for what in whats)
        except _DAMAGE as error:
            raise UnreadableFile(path, f"it cannot be unpacked ({error})") from error
    return sorted(found)


def _places_in_file(path: Path, where: str) -> Iterator[_Place]:
    with path.open("rb") as file:
        piece = file.read(_PIECE)
        if not _FILM.match(piece):
            yield from _places(where, piece + file.read(), 0)
            return
        # Videos are large and contain nothing packed that could name a person.
        while piece:
            following = file.read(_PIECE)
            yield where, piece + following[:_LONGEST_NAME], True
            piece = following


def _places(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    if depth > _DEEPEST:
        raise ValueError(f"it contains archives more than {_DEEPEST} levels deep")
    is_packed = content.startswith((SIGNATURE, _ZIP, _GZIP))
    # Packed data too: a header may contain a file's name.
    yield where, content, is_packed
    if content.startswith(SIGNATURE):
        yield from _places_in_hdf5(where, content)
    elif content.startswith(_ZIP):
        yield from _places_in_zip(where, content, depth)
    elif content.startswith(_GZIP):
        yield from _places(f"{where}, unpacked", gzip.decompress(content), depth + 1)


def _places_in_zip(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        yield where, archive.comment, False
        for info in archive.infolist():
            inside = f"{where}: {info.filename}"
            yield inside, info.filename, False
            yield inside, info.comment + info.extra, False
            yield from _places(inside, archive.read(info), depth + 1)


def _places_in_hdf5(where: str, content: bytes) -> Iterator[_Place]:
    """Yield the strings in an HDF5 file; its places are `/group/dataset@attribute`."""
    found: list[tuple[str, Any]] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(lambda name, item: found.append((name, item)))
        for name, item in [("", file), *found]:
            inside = f"{where}: /{name}"
            yield inside, name, False
            for key in item.attrs:
                yield inside, key, False
                yield from _texts(f"{inside}@{key}", item.attrs[key])
            if isinstance(item, h5py.Dataset):
                for member in item.dtype.names or ():
                    yield inside, member, False
                if item.dtype.kind in "OUS":
                    yield from _texts(inside, item[()])


def _texts(where: str, value: Any) -> Iterator[_Place]:
    array = np.asarray(value)
    for item in array.reshape(-1).tolist() if array.dtype.kind in "OUS" else ():
        text = item if isinstance(item, bytes) else str(item).encode(errors="replace")
        yield where, text, False

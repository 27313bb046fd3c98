# SPDX-License-Identifier: Apache-2.0
"""Opening what is to be verified: a packed run, be it unpacked, or recordings."""

from __future__ import annotations

import enum
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ...errors import UnreadableArchive
from ...formats.monitor_directory import iter_monitor_files
from ..layout import PAYLOAD, RECORDINGS
from .digests import digest_of
from .unpacking import unpack

# What makes a folder a bag.
BAG_DECLARATION = "bagit.txt"


class Kind(enum.StrEnum):
    """What was given to be verified."""

    ZIP = "packed run"
    BAG = "unpacked run"
    DIRECTORY = "monitor directory"


@dataclass(frozen=True, kw_only=True)
class Archive:
    """What is to be verified, where it can be read file by file.

    Attributes:
        path: as given.
        kind: what it is.
        bag: the folder that is a bag; None of a monitor directory.
        recordings: the monitor directory.
        facts: for the reader of the verification.
    """

    path: Path
    kind: Kind
    bag: Path | None
    recordings: Path
    facts: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def open_archive(path: Path, into: Path) -> Archive:
    """Return the archive that a file or a folder is.

    Args:
        path: a zip file; a folder with a bag in it, or one folder with a bag in it; or
            a monitor directory.
        into: an empty folder, for what is unpacked.

    Raises:
        UnreadableArchive: it is none of these, or damaged, or made to do harm.
        Error: there is too little room in `into`.
    """
    if path.is_dir():
        return _of_folder(path)
    try:
        digest, size = digest_of(path), path.stat().st_size
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise UnreadableArchive(path, reason or error) from error
    bag = unpack(path, into)
    return Archive(
        path=path,
        kind=Kind.ZIP,
        bag=bag,
        recordings=_recordings_of(bag, path),
        facts={"sha256": digest, "bytes": size},
    )


def _of_folder(path: Path) -> Archive:
    bag = _bag_in(path)
    if bag is not None:
        recordings = _recordings_of(bag, path)
        return Archive(path=path, kind=Kind.BAG, bag=bag, recordings=recordings)
    if next(iter_monitor_files(path), None) is None:
        raise UnreadableArchive(
            path,
            "it is neither a packed run (a zip file, or a folder with bagit.txt) nor a "
            "monitor directory: nothing is recorded in it",
        )
    return Archive(path=path, kind=Kind.DIRECTORY, bag=None, recordings=path)


def _bag_in(path: Path) -> Path | None:
    if (path / BAG_DECLARATION).exists():
        return path
    # As `unzip` leaves it.
    inside = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    if len(inside) == 1 and (inside[0] / BAG_DECLARATION).exists():
        return inside[0]
    return None


def _recordings_of(bag: Path, given: Path) -> Path:
    """Return the monitor directory inside a bag, which no link leads to."""
    place = bag
    if not _is_folder(bag):
        raise UnreadableArchive(given, "the folder that it holds is a link")
    for name in (PAYLOAD, RECORDINGS):
        place /= name
        if not _is_folder(place):
            raise UnreadableArchive(
                given,
                f"it has no folder {PAYLOAD}/{RECORDINGS}: it is not what `mjrec pack` "
                "makes",
            )
    return place


def _is_folder(path: Path) -> bool:
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except OSError:
        return False

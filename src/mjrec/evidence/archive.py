# SPDX-License-Identifier: Apache-2.0
"""Opening the input of a verification: a packed run, its folder, or recordings.

The input is untrusted, so this module copies or unpacks it into a folder in a sandbox,
laid out like a packed run. Only regular files are accepted.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from ..atomic_files import writing
from ..errors import FileNotWritten, UnreadableArchive
from ..formats.bundle import trajectories_in
from ..formats.monitor_directory import (
    infix_of,
    is_bundle,
    iter_monitor_files,
    recording_directories,
)
from ..formats.regular_files import open_regular
from ..formats.trajectory_hdf5 import open_hdf5, write_hdf5
from .layout import PAYLOAD, RECORDINGS
from .portable_names import check_distinct, portable_parts
from .zip_contents import in_order, open_plain_zip, top_folder

# A folder that contains this file is a bag.
BAG_DECLARATION = "bagit.txt"

_CHUNK = 1 << 20
# Bytes to leave free on the disk for other programs.
_ROOM = 1 << 26

# zipfile raises RuntimeError for an encrypted file, and NotImplementedError for unknown
# methods and versions.
_NOT_READ = (
    *(ValueError, zipfile.BadZipFile, zlib.error, EOFError),
    *(RuntimeError, NotImplementedError, MemoryError),
)


def bring_in(path: Path, into: Path) -> Mapping[str, Any]:
    """Bring the input of a verification into a folder, laid out like a packed run.

    Args:
        path: a zip file; a bag, or a folder whose only entry is a bag; or a monitor
            directory, or a folder of monitor directories.
        into: a folder that does not exist yet.

    Returns:
        `kind`; for a zip file also its `sha256` and `bytes`.

    Raises:
        UnreadableArchive: the input is none of these, is damaged or is malicious.
        FileNotWritten: there is too little disk space.
    """
    try:
        facts: dict[str, Any]
        if path.is_dir():
            facts = {"kind": _copy_in(path, into)}
        else:
            digest, size = digest_of(path, "sha256"), path.stat().st_size
            facts = {"kind": "packed run", "sha256": digest, "bytes": size}
            _unpack(path, into)
    except FileNotWritten:
        raise
    except OSError as error:
        raise UnreadableArchive(path, error.strerror or error) from error
    except _NOT_READ as error:
        raise UnreadableArchive(path, error) from error
    if not (into / PAYLOAD / RECORDINGS).is_dir():
        raise UnreadableArchive(
            path,
            f"it has no folder {PAYLOAD}/{RECORDINGS}, so it does not come from "
            "`mjrec pack`",
        )
    return facts


def digest_of(path: Path, algorithm: str) -> str:
    """Return the digest of a regular file, in hexadecimal digits.

    Raises:
        OSError: the file cannot be read.
        ValueError: the path is not a regular file.
    """
    with open_regular(path) as file:
        return hashlib.file_digest(file, algorithm).hexdigest()


def _copy_in(path: Path, into: Path) -> str:
    """Copy a bag or the files of monitor directories; return the kind of the folder."""
    bag = _bag_in(path)
    if bag is not None:
        files = {each.relative_to(bag).as_posix(): each for each in _files_below(bag)}
        _copy_files(files, into, given=path)
        return "unpacked run"
    recordings: dict[str, Path] = {}
    for place in recording_directories(path):
        for file in iter_monitor_files(place):
            # Models are named after their content, so two monitors may share one.
            if recordings.setdefault(file.name, file) != file and infix_of(file.name):
                raise UnreadableArchive(path, f"{file.name} is in two of its folders")
    if not recordings:
        raise UnreadableArchive(
            path,
            "it is neither a packed run (a zip file, or a folder with bagit.txt) nor a "
            "monitor directory: it contains no recordings",
        )
    _copy_files(recordings, into / PAYLOAD / RECORDINGS, given=path)
    _unbundle(into / PAYLOAD / RECORDINGS)
    return "monitor directory"


def _bag_in(path: Path) -> Path | None:
    if (path / BAG_DECLARATION).exists():
        return path
    # The folder that `unzip` creates.
    inside = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    if len(inside) == 1 and (inside[0] / BAG_DECLARATION).exists():
        if inside[0].is_symlink():
            raise UnreadableArchive(path, "the only folder in it is a link")
        return inside[0]
    return None


def _files_below(folder: Path) -> list[Path]:
    """Return all files below a folder; reject links and empty folders.

    The manifests of a bag list only files, so an empty folder could not be checked.
    """
    found: list[Path] = []
    for entry in folder.iterdir():
        status = entry.lstat()
        if stat.S_ISDIR(status.st_mode):
            files = _files_below(entry)
            if not files:
                raise ValueError(f"{entry.name[:200]!r} is an empty folder")
            found += files
        elif stat.S_ISREG(status.st_mode):
            found.append(entry)
        else:
            raise ValueError(f"{entry.name!r} is neither a file nor a folder")
    return found


def _unbundle(recordings: Path) -> None:
    """Give each trajectory its own file, as in a packed run."""
    for bundle in [p for p in iter_monitor_files(recordings) if is_bundle(p.name)]:
        for path in trajectories_in(bundle):
            with open_hdf5(path) as reader:
                write_hdf5(reader, path)
        bundle.unlink()


def _copy_files(files: Mapping[str, Path], into: Path, *, given: Path) -> None:
    check_distinct([*files])
    into.mkdir(parents=True)
    _check_room(sum(path.lstat().st_size for path in files.values()), into, given)
    for name, path in files.items():
        with open_regular(path) as source:
            _write(into, name, source, os.fstat(source.fileno()).st_size)


def _unpack(path: Path, into: Path) -> None:
    """Unpack a zip file's only folder.

    Files are streamed to the disk and their bytes are counted. An archive that contains
    more than it declares is rejected at the first extra byte.
    """
    with open_plain_zip(path) as archive:
        top, infos = top_folder(archive), in_order(archive)
        unpacked = into.with_name(f"{into.name}.unpacked")
        unpacked.mkdir()
        _check_room(sum(info.file_size for info in infos), unpacked, path)
        for info in infos:
            name = info.filename
            if info.is_dir():
                parts = portable_parts(name.removesuffix("/"))
                unpacked.joinpath(*parts).mkdir(parents=True, exist_ok=True)
                continue
            with archive.open(info) as packed:
                _write(unpacked, name, packed, info.file_size)
    _files_below(unpacked)
    (unpacked / top).rename(into)


def _check_room(size: int, into: Path, path: Path) -> None:
    free = shutil.disk_usage(into).free
    if size + _ROOM > free:
        raise FileNotWritten(
            into.parent,
            f"unpacking {path} takes {size} bytes, but only {free} are free",
            then="or set TMPDIR to a directory on another disk",
        )


def _write(folder: Path, name: str, source: IO[bytes], size: int) -> None:
    """Copy a file of exactly `size` bytes into a folder."""
    target, left = folder.joinpath(*portable_parts(name)), size
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        output = target.open("xb")
    with output:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                break
            with writing(target):
                output.write(chunk)
    if left:
        raise ValueError(f"{target.name!r} does not have the declared size")

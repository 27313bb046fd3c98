# SPDX-License-Identifier: Apache-2.0
"""Videos packed for upload: gym's archive.

A gzipped tar file, flat::

    <video>, <its metadata>      for each pair, in the order given
    manifest.json                {"version": 0, "videos": [[video, metadata], ...]}

It depends on the names and contents of the files alone: their times, owners and
permissions are left out, so the same videos give the same bytes.
"""

from __future__ import annotations

import errno
import gzip
import io
import os
import re
import shutil
import stat
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO

from ..errors import ArchiveError
from ..json_text import dumps
from .regular_files import open_regular

MAX_VIDEOS = 100

_MANIFEST = "manifest.json"
_VIDEO_NAME = re.compile(r"[\w.-]+\.(mp4|avi|json)", re.ASCII)
_METADATA_NAME = re.compile(r"[\w.-]+\.meta\.json", re.ASCII)

_Pair = tuple[Path, Path]


def write_archive(
    videos: Iterable[tuple[str | os.PathLike[str], str | os.PathLike[str]]],
    archive_file: IO[bytes],
    env_id: str | None = None,
) -> None:
    """Write gym's archive of videos with their metadata.

    Everything is checked and read before the first byte is written.

    Args:
        videos: pairs of video path and metadata path, as in
            `load_results(...)["videos"]`; at most 100, with different names.
        archive_file: a binary file open for writing. It is not closed.
        env_id: the environment, for error messages.

    Raises:
        ArchiveError: a file is missing, unreadable, no regular file, or has a name that
            is not allowed. Nothing was written.
    """
    pairs = [(Path(video), Path(metadata)) for video, metadata in videos]
    for reason in _objections(pairs):
        raise ArchiveError(f"[{env_id}] {reason}")
    with tempfile.TemporaryFile() as whole:
        try:
            _pack(pairs, whole)
        except OSError as error:
            reason = f"Cannot read {error.filename}: {error.strerror}."
            raise ArchiveError(f"[{env_id}] {reason}") from error
        whole.seek(0)
        shutil.copyfileobj(whole, archive_file)


def _objections(pairs: Sequence[_Pair]) -> Iterator[str]:
    """Yield why there will be no archive, in the order in which gym looked."""
    if len(pairs) > MAX_VIDEOS:
        yield (
            f"{len(pairs)} videos were given, and an archive holds at most "
            f"{MAX_VIDEOS}. Write several archives."
        )
    taken: set[str] = set()
    for video, metadata in pairs:
        if not os.path.lexists(video):
            yield (
                f"There is no video {video}. Its recording may have failed: see the "
                "recorder's `functional`."
            )
        if not os.path.lexists(metadata):
            yield f"There is no metadata {metadata} for the video {video}."
        for path in (video, metadata):
            if not stat.S_ISREG(path.lstat().st_mode):
                yield f"{path} is a link, a directory or a device. Give the file."
        for path in (video, metadata):
            if path.name in taken:
                yield (
                    f"The name {path.name!r} is there twice (the second time as "
                    f"{path}), and an archive has no directories."
                )
            taken.add(path.name)
        plain = "it must be letters, digits, '_', '-' and '.', ending in"
        if not _VIDEO_NAME.fullmatch(video.name):
            yield f"{video.name!r} is no name for a video: {plain} .mp4, .avi or .json."
        if video.name.endswith(".meta.json"):
            yield f"{video.name!r} is the name of metadata, not of a video."
        if video.name.lower() == _MANIFEST:
            yield f"{video.name!r} is the archive's own list, and no name for a video."
        if not _METADATA_NAME.fullmatch(metadata.name):
            yield f"{metadata.name!r} is no name for metadata: {plain} .meta.json."


def _pack(pairs: Sequence[_Pair], whole: IO[bytes]) -> None:
    names = [[video.name, metadata.name] for video, metadata in pairs]
    manifest = dumps({"version": 0, "videos": names}).encode()
    # Through a stream of our own, because tarfile puts time and name into gzip's
    # header.
    with (
        gzip.GzipFile(filename="", mode="wb", fileobj=whole, mtime=0) as stream,
        tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar,
    ):
        for pair in pairs:
            for path in pair:
                _add_file(tar, path)
        _add(tar, _MANIFEST, len(manifest), io.BytesIO(manifest))


def _add_file(tar: tarfile.TarFile, path: Path) -> None:
    try:
        with open_regular(path) as file:
            _add(tar, path.name, os.fstat(file.fileno()).st_size, file)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise OSError(errno.EIO, reason or str(error), str(path)) from error


def _add(tar: tarfile.TarFile, name: str, size: int, content: IO[bytes]) -> None:
    # A new TarInfo has mtime 0, uid and gid 0, no names and mode 0644.
    member = tarfile.TarInfo(name)
    member.size = size
    tar.addfile(member, content)

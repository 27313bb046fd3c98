# SPDX-License-Identifier: Apache-2.0
"""Gym's archive: videos packed for upload.

The archive is a gzipped tar file without directories::

    <video>, <its metadata>      for each pair, in the order given
    manifest.json                {"version": 0, "videos": [[video, metadata], ...]}

The archive depends only on the names and contents of the files, not on their times,
owners or permissions. The same videos always produce the same bytes.
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
    """Write videos and their metadata to an archive in gym's format.

    All files are checked and read before the first byte is written.

    Args:
        videos: pairs of video path and metadata path, as in
            `load_results(...)["videos"]`; at most 100, all with different names.
        archive_file: a binary file open for writing. It is not closed.
        env_id: the environment's id, for error messages.

    Raises:
        ArchiveError: a file is missing, unreadable or not a regular file, or its name
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
    """Yield the reasons why these pairs cannot be archived, in gym's order."""
    if len(pairs) > MAX_VIDEOS:
        yield (
            f"{len(pairs)} videos were given, but an archive holds at most "
            f"{MAX_VIDEOS}. Write several archives."
        )
    taken: set[str] = set()
    for video, metadata in pairs:
        if not os.path.lexists(video):
            yield (
                f"The video {video} does not exist. Its recording may have failed: "
                "check the recorder's `functional`."
            )
        if not os.path.lexists(metadata):
            yield f"{metadata}, the metadata of the video {video}, does not exist."
        for path in (video, metadata):
            if not stat.S_ISREG(path.lstat().st_mode):
                yield f"{path} is a link, a directory or a device. Use a regular file."
        for path in (video, metadata):
            if path.name in taken:
                yield (
                    f"The name {path.name!r} occurs twice (the second time as {path}), "
                    "but an archive has no directories. Rename one of the files."
                )
            taken.add(path.name)
        plain = "it must consist of letters, digits, '_', '-' and '.', and end in"
        if not _VIDEO_NAME.fullmatch(video.name):
            yield f"{video.name!r} is not a video name: {plain} .mp4, .avi or .json."
        if video.name.endswith(".meta.json"):
            yield f"{video.name!r} is a metadata file's name, not a video's."
        if video.name.lower() == _MANIFEST:
            yield f"{video.name!r} is the name of the archive's manifest. Rename it."
        if not _METADATA_NAME.fullmatch(metadata.name):
            yield (
                f"{metadata.name!r} is not a metadata file name: {plain} .meta.json."
            )


def _pack(pairs: Sequence[_Pair], whole: IO[bytes]) -> None:
    names = [[video.name, metadata.name] for video, metadata in pairs]
    manifest = dumps({"version": 0, "videos": names}).encode()
    # Use our own gzip stream, because tarfile writes the time and the name into gzip's
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

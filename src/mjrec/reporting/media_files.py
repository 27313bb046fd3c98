# SPDX-License-Identifier: Apache-2.0
"""The videos of a report, copied beside its page or put into it.

What is copied is a copy and no link: a report is as good without the recordings. Its
files have names that this module makes, whatever the recorded ones are called.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ..errors import FileNotWritten, UnreadableFile
from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular
from ..machine import usable_cpus
from .contents import ReportContents, ReportVideo
from .posters import Poster, poster_of
from .video_stream import video_kind

VIDEOS: Final = "videos"
POSTERS: Final = "posters"

_TEXT: Final = ".json"
_JPEG: Final = ".jpg"
_MEDIA_TYPES: Final = {
    ".mp4": "video/mp4",
    ".avi": "video/x-msvideo",
    ".mkv": "video/x-matroska",
}
_OWN_NAME: Final = re.compile(r"\d{4,18}-[a-z0-9-]{1,60}\.(mp4|avi|mkv|json|jpg)")
_READ_SIZE: Final = 1 << 20
_LONGEST_SLUG: Final = 60


@dataclass(frozen=True)
class ReportProgress:
    """How far the making of a report is.

    Attributes:
        what: `"posters"` or `"videos"`.
        done: how many.
        total: of how many.
    """

    what: str
    done: int
    total: int


OnProgress = Callable[[ReportProgress], object]


@dataclass
class _Said:
    """What becomes of the videos while they are copied."""

    videos: list[ReportVideo]
    problems: list[str]

    @classmethod
    def of(cls, contents: ReportContents) -> _Said:
        return cls(list(contents.videos), list(contents.problems))

    def leave_out(self, index: int, why: str) -> None:
        """Show a video without its file."""
        video = self.videos[index]
        self.problems.append(f"The video {video.file} is left out: {why}")
        notes = (*video.notes, "The file of this video is not part of the report.")
        self.videos[index] = dataclasses.replace(video, file="", notes=notes)

    def contents(self, contents: ReportContents) -> ReportContents:
        return dataclasses.replace(
            contents,
            videos=tuple(self.videos),
            problems=tuple(dict.fromkeys(self.problems)),
        )


def is_own_name(name: str) -> bool:
    """Tell whether a report's video or poster may be called so."""
    return _OWN_NAME.fullmatch(name) is not None


def with_posters(
    contents: ReportContents, on_progress: OnProgress
) -> tuple[ReportContents, list[bytes | None]]:
    """Return contents with what the videos' files say of time, and their posters.

    Args:
        contents: whose videos have their recorded files.
        on_progress: is told of each poster.
    """
    said = _Said.of(contents)
    pictures: list[bytes | None] = [None] * len(said.videos)
    moving = [
        index
        for index, video in enumerate(said.videos)
        if not video.file.endswith(_TEXT)
    ]
    # Each is a short run of ffmpeg, on one CPU.
    with ThreadPoolExecutor(usable_cpus()) as pool:
        files = [Path(said.videos[index].file) for index in moving]
        made: list[Poster] = []
        for poster in pool.map(poster_of, files):
            made.append(poster)
            on_progress(ReportProgress(POSTERS, len(made), len(moving)))
    for index, poster in zip(moving, made, strict=True):
        pictures[index] = poster.jpeg
        video = said.videos[index]
        if video.seconds is None and poster.seconds is not None:
            said.videos[index] = dataclasses.replace(video, seconds=poster.seconds)
        if poster.problem is not None:
            said.problems.append(f"There is no picture of a video: {poster.problem}")
    return said.contents(contents), pictures


def with_copied_videos(
    contents: ReportContents,
    posters: Sequence[bytes | None],
    folder: Path,
    on_progress: OnProgress,
) -> ReportContents:
    """Copy videos and posters into a folder, and return contents that name the copies.

    Args:
        contents: whose videos have their recorded files.
        posters: of the videos.
        folder: of the page.
        on_progress: is told of each video.

    Raises:
        FileNotWritten: the disk is full.
    """
    said = _Said.of(contents)
    for index, video in enumerate(contents.videos):
        stem = _stem(contents, index)
        try:
            ending = _ending(Path(video.file))
            name = f"{VIDEOS}/{stem}{ending}"
            sha256 = _copy(Path(video.file), folder / name)
        except UnreadableFile as error:
            said.leave_out(index, error.reason + ".")
        else:
            said.videos[index] = _of_file(said, index, name, sha256)
        jpeg = posters[index]
        if jpeg is not None:
            name = f"{POSTERS}/{stem}{_JPEG}"
            _write(folder / name, jpeg)
            said.videos[index] = dataclasses.replace(said.videos[index], poster=name)
        on_progress(ReportProgress(VIDEOS, index + 1, len(contents.videos)))
    return said.contents(contents)


def with_embedded_videos(
    contents: ReportContents, posters: Sequence[bytes | None], *, room: int
) -> ReportContents:
    """Return contents whose videos stand in the page itself, as far as there is room.

    All posters come first, then the videos in their order. What is left out is shown
    by its poster, and says so.

    Args:
        contents: whose videos have their recorded files.
        posters: of the videos.
        room: for how many bytes, as they stand in the page.
    """
    said = _Said.of(contents)
    for index, jpeg in enumerate(posters):
        url = None if jpeg is None else _data_url("image/jpeg", jpeg)
        if url is not None and len(url) <= room:
            room -= len(url)
            said.videos[index] = dataclasses.replace(said.videos[index], poster=url)
    left_out = 0
    for index, video in enumerate(contents.videos):
        try:
            media_type = _MEDIA_TYPES.get(_ending(Path(video.file)))
            size = Path(video.file).stat().st_size
            # Four characters for three bytes.
            if media_type is None or 4 * (size // 3 + 1) + 100 > room:
                left_out += 1
                said.videos[index] = _not_embedded(said.videos[index])
                continue
            data = _read(Path(video.file))
        except (OSError, UnreadableFile) as error:
            reason = error.reason if isinstance(error, UnreadableFile) else error
            said.leave_out(index, f"{reason}.")
            continue
        url = _data_url(media_type, data)
        room -= len(url)
        sha256 = hashlib.sha256(data).hexdigest()
        said.videos[index] = _of_file(said, index, url, sha256)
    if left_out:
        said.problems.append(
            f"{left_out} of {len(contents.videos)} videos are not embedded, because "
            "this one file would be too large: a report that is a folder has all of "
            "them."
        )
    return said.contents(contents)


def _not_embedded(video: ReportVideo) -> ReportVideo:
    note = f"Not embedded, for its size. It is the file {video.file}."
    return dataclasses.replace(video, file="", notes=(*video.notes, note))


def _of_file(said: _Said, index: int, file: str, sha256: str) -> ReportVideo:
    """Return a video whose file is in the report, with the hash that it has."""
    video = said.videos[index]
    notes = video.notes
    if video.sha256 is not None and video.sha256 != sha256:
        note = (
            "This is not the file that its metadata describe: they have the SHA-256 "
            f"{video.sha256}."
        )
        notes = (*notes, note)
        said.problems.append(f"The video {video.name} was changed. {note}")
    return dataclasses.replace(video, file=file, sha256=sha256, notes=notes)


def _ending(path: Path) -> str:
    """Return the ending of a copy, by what the file is.

    Raises:
        UnreadableFile: it is nothing that a report shows, or cannot be read.
    """
    kind = video_kind(path)
    if kind is not None:
        return kind
    if path.name.endswith(_TEXT):
        return _TEXT
    raise UnreadableFile(path, "it is no video of a kind that is known here")


def _stem(contents: ReportContents, index: int) -> str:
    name = contents.tasks[contents.videos[index].task].name
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:_LONGEST_SLUG]
    return f"{index:04d}-{slug.strip('-') or 'video'}"


def _copy(source: Path, target: Path) -> str:
    """Copy a file, and return its sha256."""
    digest = hashlib.sha256()
    with unreadable(source), open_regular(source) as file:
        try:
            copy = target.open("xb")
        except OSError as error:
            raise FileNotWritten(target, error.strerror) from error
        with copy:
            while block := file.read(_READ_SIZE):
                digest.update(block)
                _append(copy.write, block, target)
    return digest.hexdigest()


def _append(write: Callable[[bytes], int], block: bytes, target: Path) -> None:
    try:
        write(block)
    except OSError as error:
        raise FileNotWritten(target, error.strerror) from error


def _write(target: Path, data: bytes) -> None:
    try:
        target.write_bytes(data)
    except OSError as error:
        raise FileNotWritten(target, error.strerror) from error


def _read(path: Path) -> bytes:
    with unreadable(path), open_regular(path) as file:
        return file.read()


def _data_url(media_type: str, data: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"

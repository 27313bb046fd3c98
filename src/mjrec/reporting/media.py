# SPDX-License-Identifier: Apache-2.0
"""A report's videos, copied next to the page or embedded in it.

Videos are copied, not linked, so that a report does not need the recordings. The copies
get new names, which do not depend on the original names.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from imageio.v3 import imwrite

from ..errors import Error, InvalidArgument, UnreadableFile
from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular
from ..machine import usable_cpus
from .contents import ReportContents, ReportVideo
from .video_stream import frames_at, read_stream, video_kind

VIDEOS: Final = "videos"
POSTERS: Final = "posters"
REPLAYS: Final = "replays"

_TEXT: Final = ".json"
_MEDIA_TYPES: Final = {
    ".mp4": "video/mp4",
    ".avi": "video/x-msvideo",
    ".mkv": "video/x-matroska",
}
_OWN_NAME: Final = re.compile(r"\d{4,18}-[a-z0-9-]{1,60}\.(mp4|avi|mkv|json|jpg|html)")
_READ_SIZE: Final = 1 << 20
_LONGEST_SLUG: Final = 60
_POSTER_WIDTH: Final = 640
_POSTER_QUALITY: Final = 85


@dataclass(frozen=True)
class ReportProgress:
    """The progress of writing a report.

    Attributes:
        what: `"posters"`, `"videos"` or `"replays"`.
        done: number of finished items.
        total: number of items.
    """

    what: str
    done: int
    total: int


OnProgress = Callable[[ReportProgress], object]


def is_own_name(name: str) -> bool:
    """Return whether a name has the form of a video, poster or replay in a report."""
    return _OWN_NAME.fullmatch(name) is not None


def add_images(contents: ReportContents, on_progress: OnProgress) -> None:
    """Set the still image of each video, except for text recordings and broken videos.

    Missing video durations are filled in. Videos that cannot be decoded are listed as
    problems.

    Args:
        contents: the contents, whose videos still have their recorded files.
        on_progress: called after each image.
    """
    moving = [video for video in contents.videos if video.path.suffix != _TEXT]
    # Each image takes a short run of ffmpeg on one CPU.
    with ThreadPoolExecutor(usable_cpus()) as pool:
        for number, error in enumerate(pool.map(_add_image, moving), 1):
            if error is not None:
                contents.problems.append(f"A video has no poster: {error}")
            on_progress(ReportProgress(POSTERS, number, len(moving)))


def _add_image(video: ReportVideo) -> Error | None:
    """Set a video's image to its middle frame as a JPEG; return the error, if any.

    The first frame often shows the initial pose, which is the same in all videos of a
    task. The last frame often shows a fall. The action is in between.
    """
    try:
        stream = read_stream(video.path)
        if video.seconds is None:
            video.seconds = stream.seconds
        middle = (len(stream) - 1) // 2
        [frame] = frames_at(stream, [middle], most_width=_POSTER_WIDTH)
    except Error as error:
        return error
    image: Any = imwrite("<bytes>", frame, extension=".jpg", quality=_POSTER_QUALITY)
    video.image = bytes(image)
    return None


def copy_videos(
    contents: ReportContents, folder: Path, on_progress: OnProgress
) -> None:
    """Copy videos and images into a folder, and set their names in the contents.

    Args:
        contents: the contents, whose videos still have their recorded files.
        folder: the page's folder.
        on_progress: called after each video.

    Raises:
        OSError: the disk is full.
    """
    for number, (stem, video) in enumerate(_named(contents), 1):
        try:
            file = f"{VIDEOS}/{stem}{_ending(video.path)}"
            _put(contents, video, file, _copy(video.path, folder / file))
        except UnreadableFile as error:
            _leave_out(contents, video, error)
        if video.image is not None:
            video.poster = f"{POSTERS}/{stem}.jpg"
            (folder / video.poster).write_bytes(video.image)
        on_progress(ReportProgress(VIDEOS, number, len(contents.videos)))


def _named(contents: ReportContents) -> Iterator[tuple[str, ReportVideo]]:
    """Yield each video with the stem of its files' names in the report."""
    pairs = ((task, video) for task in contents.tasks for video in task.videos)
    for index, (task, video) in enumerate(pairs):
        slug = re.sub(r"[^a-z0-9]+", "-", task.name.lower()).strip("-")
        slug = slug[:_LONGEST_SLUG].strip("-") or "video"
        yield f"{index:04d}-{slug}", video


def write_replays(
    contents: ReportContents, folder: Path, on_progress: OnProgress
) -> None:
    """Write a 3D page for each best, median and worst episode with recorded states.

    Args:
        contents: the contents, in which each video gets the name of its page.
        folder: the report's folder.
        on_progress: called after each page.

    Raises:
        MissingDependency: viser is not installed.
        FileNotWritten: the disk is full.
    """
    # Imported here, because it needs viser and MuJoCo, which other reports do not.
    from ..simulation.trajectories import load_trajectory
    from ..viewing.replay import write_replay

    wanted = [
        (stem, video, video.trajectory)
        for stem, video in _named(contents)
        if video.roles and video.trajectory is not None
    ]
    done: dict[Path, str] = {}
    for number, (stem, video, path) in enumerate(wanted, 1):
        try:
            if path not in done:
                page = f"{REPLAYS}/{stem}.html"
                write_replay(load_trajectory(path), folder / page)
                done[path] = page
            # Videos from several cameras show the same episode.
            video.replay = done[path]
        except (InvalidArgument, UnreadableFile) as error:
            contents.problems.append(f"An episode is not shown in 3D: {error}")
        on_progress(ReportProgress(REPLAYS, number, len(wanted)))


def with_embedded_videos(contents: ReportContents, *, room: int) -> ReportContents:
    """Return contents with as many embedded videos as possible.

    All images come first, then the videos in order. A video that does not fit is
    represented by its image and a note.

    Args:
        contents: the contents, whose videos have their recorded files; not modified.
        room: maximum number of characters for all embedded data.
    """
    contents = replace(
        contents,
        problems=[*contents.problems],
        tasks=[
            replace(task, videos=[replace(v, notes=[*v.notes]) for v in task.videos])
            for task in contents.tasks
        ],
    )
    for video in contents.videos:
        if video.image is not None and _length_of_url(len(video.image)) <= room:
            video.poster = _data_url("image/jpeg", video.image)
            room -= len(video.poster)
    left_out = 0
    for video in contents.videos:
        try:
            media_type = _MEDIA_TYPES.get(_ending(video.path))
            with unreadable(video.path), open_regular(video.path) as file:
                data = file.read(max(0, room)) if media_type else b""
                is_whole = not file.read(1)
        except UnreadableFile as error:
            _leave_out(contents, video, error)
            continue
        if media_type and is_whole and _length_of_url(len(data)) <= room:
            url = _data_url(media_type, data)
            _put(contents, video, url, hashlib.sha256(data).hexdigest())
            room -= len(url)
        else:
            left_out += 1
            note = f"Not embedded because of its size. Its file is {video.path}."
            video.notes.append(note)
    if left_out:
        contents.problems.append(
            f"{left_out} of {len(contents.videos)} videos are not embedded, because "
            "this file would become too large. A report in a folder contains all of "
            "them."
        )
    return contents


def _put(contents: ReportContents, video: ReportVideo, file: str, sha256: str) -> None:
    """Set a video's file in the report and its hash; report a changed hash."""
    if video.sha256 not in (None, sha256):
        note = (
            "This file does not match its metadata, which gives the SHA-256 "
            f"{video.sha256}."
        )
        video.notes.append(note)
        contents.problems.append(f"The video {video.path.name} was changed. {note}")
    video.file, video.sha256 = file, sha256


def _copy(source: Path, target: Path) -> str:
    """Copy a file, and return its SHA-256."""
    digest = hashlib.sha256()
    with unreadable(source):
        file = open_regular(source)
    with file, target.open("xb") as copy:
        while True:
            # A full disk is not an error in the source.
            with unreadable(source):
                block = file.read(_READ_SIZE)
            if not block:
                return digest.hexdigest()
            digest.update(block)
            copy.write(block)


def _leave_out(
    contents: ReportContents, video: ReportVideo, error: UnreadableFile
) -> None:
    problem = f"The video {video.path} is left out: {error.reason}."
    contents.problems.append(problem)
    video.notes.append("The file of this video is not part of the report.")


def _ending(path: Path) -> str:
    """Return the suffix for the copy of a file, from its contents.

    Raises:
        UnreadableFile: the file cannot be shown in a report, or cannot be read.
    """
    kind = video_kind(path) or (_TEXT if path.suffix == _TEXT else None)
    if kind is None:
        raise UnreadableFile(path, "it is not a video in a supported format")
    return kind


def _length_of_url(size: int) -> int:
    # Base64 has four characters for three bytes.
    return 4 * (size // 3 + 1) + 100


def _data_url(media_type: str, data: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"

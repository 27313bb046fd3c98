# SPDX-License-Identifier: Apache-2.0
"""A report in a folder, or in one file.

::

    report/
    ├── index.html      opens from the disk and needs no network
    ├── videos/         copies: 0000-dm-control-walker-walk.mp4 ...
    ├── posters/        a frame of each: 0000-dm-control-walker-walk.jpg ...
    └── replays/        pages in 3D of some: 0000-dm-control-walker-walk.html ...

The folder can be moved, and is whole without the recordings. It appears under its name
when it is complete; one that was there is replaced then, if it was a report and nothing
else.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from ..atomic_files import temporary_path, write_text
from ..errors import DirectoryNotWritable, FileNotWritten, InvalidArgument
from ..formats.regular_files import open_regular
from .contents import ReportContents
from .gathering import Directories, gather
from .media import (
    POSTERS,
    REPLAYS,
    VIDEOS,
    OnProgress,
    copy_videos,
    is_own_name,
    posters_of,
    with_embedded_videos,
    write_replays,
)
from .page import page_of

PAGE_NAME: Final = "index.html"

_FOLDERS: Final = (VIDEOS, POSTERS, REPLAYS)
_PAGE_ENDINGS: Final = (".html", ".htm")
_GENERATOR: Final = re.compile(rb'<meta name="generator" content="mjrec [^"]*">')
_BEGIN: Final = 4096
_SHOWN: Final = 5


def write_report(
    directories: Directories,
    path: str | os.PathLike[str] = "report",
    *,
    title: str | None = None,
    single_file: bool = False,
    max_single_file_bytes: int = 50_000_000,
    replays: bool = False,
    verifications: Iterable[str | os.PathLike[str]] = (),
    on_progress: OnProgress | None = None,
) -> Path:
    """Write a web page about recordings, and return its path.

    It has a summary of each task, curves, videos, all episodes, and their provenance.
    It works for evaluations and for any monitor directory, also of old gym, without
    MuJoCo and OpenGL. An unreadable file is named on the page.

    Args:
        directories: evaluations, monitor directories, or folders that contain some; one
            or several.
        path: the folder to write. An existing report is replaced; another folder that
            is not empty is left alone. With `single_file` it may end in `.html`, and is
            then the page.
        title: of the page. None is what was recorded.
        single_file: put images and videos into the page: posters first, then videos in
            order, up to `max_single_file_bytes`; the rest is named.
        max_single_file_bytes: size limit of the page with `single_file`.
        replays: put a 3D page (`write_replay`) beside the videos of the best, median
            and worst episode. It is loaded when it is opened.
        verifications: outputs of `mjrec verify --json`. A `verification.json` in a
            directory is found by itself.
        on_progress: called with a `ReportProgress` for each poster and video.

    Raises:
        InvalidArgument: a directory has no recordings, `path` is not a report, the
            page alone is larger than `max_single_file_bytes`, or `replays` are wanted
            in it.
        UnreadableFile: one of `verifications` cannot be read.
        MissingDependency: Jinja2 is not installed, or viser for replays.
        FileNotWritten, DirectoryNotWritable: the disk is full or read-only.
    """
    target = Path(os.path.realpath(path))
    is_page = target.suffix.lower() in _PAGE_ENDINGS
    if is_page and not single_file:
        raise InvalidArgument(
            f"{path} names a page, and a report is a folder: name the folder, or ask "
            "for one file (single_file=True, --single-file)."
        )
    if replays and single_file:
        raise InvalidArgument(
            "Replays are pages of their own, beside the report: write a folder "
            "(single_file=False, without --single-file)."
        )
    _check_target(target, is_page=is_page)
    tell = on_progress or (lambda progress: None)
    contents = gather(directories, title=title, verifications=verifications)
    posters = posters_of(contents, tell)
    if single_file:
        page = _single_page(contents, posters, max_single_file_bytes)
        if is_page:
            _make_parents(target)
            write_text(target, page)
            return Path(path)
    with _replacing_folder(target) as folder:
        if not single_file:
            copy_videos(contents, posters, folder, tell)
            if replays:
                write_replays(contents, folder, tell)
            page = page_of(contents)
        write_text(folder / PAGE_NAME, page)
    return Path(path) / PAGE_NAME


def _single_page(
    contents: ReportContents, posters: Sequence[bytes | None], most_bytes: int
) -> str:
    room = most_bytes
    while True:
        page = page_of(with_embedded_videos(contents, posters, room=room))
        size = len(page.encode())
        if size <= most_bytes:
            return page
        if room <= 0:
            raise InvalidArgument(
                f"The page has {size} bytes without any image or video, and "
                f"max_single_file_bytes allows {most_bytes}. Allow more, or write a "
                "folder."
            )
        # The page has text, too.
        room -= size - most_bytes


def _check_target(target: Path, *, is_page: bool) -> None:
    """Raise InvalidArgument if there is something that is not to be replaced."""
    if not os.path.lexists(target):
        return
    if is_page:
        if not _is_own_page(target):
            raise InvalidArgument(
                f"{target} exists and is no report, so it is not replaced: choose "
                "another name, or remove it."
            )
        return
    if not target.is_dir():
        raise InvalidArgument(
            f"{target} is a file, and a report is a folder: choose another name."
        )
    names = {entry.name for entry in target.iterdir()}
    if not names:
        return
    foreign = sorted(names - {PAGE_NAME, *_FOLDERS}) + sorted(
        f"{folder}/{entry.name}"
        for folder in _FOLDERS
        if (target / folder).is_dir()
        for entry in (target / folder).iterdir()
        if not is_own_name(entry.name)
    )
    if not _is_own_page(target / PAGE_NAME):
        foreign = sorted(names)
    if foreign:
        more = f" and {len(foreign) - _SHOWN} more" if len(foreign) > _SHOWN else ""
        raise InvalidArgument(
            f"{target} holds files that are no report: "
            f"{', '.join(foreign[:_SHOWN])}{more}. It is not replaced: choose another "
            "folder, or move them away."
        )


def _is_own_page(path: Path) -> bool:
    try:
        with open_regular(path) as file:
            return _GENERATOR.search(file.read(_BEGIN)) is not None
    except (OSError, ValueError):
        return False


def _make_parents(target: Path) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(target.parent, error.strerror) from error


@contextlib.contextmanager
def _replacing_folder(target: Path) -> Iterator[Path]:
    """Yield a new folder beside `target`, and put it there at the end of the block.

    If the block raises, it is removed, and what was there stays as it was.
    """
    _make_parents(target)
    folder, before = temporary_path(target), temporary_path(target)
    try:
        for name in ("", *_FOLDERS):
            (folder / name).mkdir()
    except OSError as error:
        raise DirectoryNotWritable(target.parent, error.strerror) from error
    try:
        yield folder
        for name in _FOLDERS:
            if not any((folder / name).iterdir()):
                (folder / name).rmdir()
        if target.exists():
            target.rename(before)
        folder.rename(target)
    except OSError as error:
        raise FileNotWritten(
            target, error.strerror, then="the same command writes it again"
        ) from error
    finally:
        if before.exists() and not target.exists():
            before.rename(target)
        for left in (folder, before):
            shutil.rmtree(left, ignore_errors=True)

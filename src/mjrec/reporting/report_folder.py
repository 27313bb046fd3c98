# SPDX-License-Identifier: Apache-2.0
"""A report in a folder, or in one file.

::

    report/
    ├── index.html      opens from disk and needs no network
    ├── videos/         copies: 0000-dm-control-walker-walk.mp4 ...
    ├── posters/        a frame of each: 0000-dm-control-walker-walk.jpg ...
    └── replays/        3D pages of some: 0000-dm-control-walker-walk.html ...

The folder can be moved, and does not need the recordings. It gets its final name only
when complete. It then replaces an existing folder if that contains only a report.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from ..atomic_files import make_directory, temporary_path, write_text
from ..errors import DirectoryNotWritable, FileNotWritten, InvalidArgument
from ..formats.regular_files import open_regular
from ..plain_text import counted, listed
from . import media
from .contents import ReportContents
from .gathering import Directories, gather
from .page import page_of

logger = logging.getLogger(__name__)

PAGE_NAME: Final = "index.html"

_FOLDERS: Final = (media.VIDEOS, media.POSTERS, media.REPLAYS)
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
    on_progress: media.OnProgress | None = None,
) -> Path:
    """Write a web page about recordings, and return its path.

    The page has a summary of each task, curves, videos, all episodes, and their
    provenance. It supports evaluations and all monitor directories, including old
    gym's, and needs neither MuJoCo nor OpenGL. Unreadable files are listed on the page.

    Args:
        directories: one or more evaluations, monitor directories, or folders that
            contain them.
        path: the folder to write. An existing report is replaced; any other non-empty
            folder is left alone. With `single_file`, a path that ends in `.html` is the
            page itself.
        title: title of the page. None derives it from the recordings.
        single_file: put images and videos into the page itself: posters first, then
            videos in order, up to `max_single_file_bytes`. The rest is only listed.
        max_single_file_bytes: size limit for the page with `single_file`.
        replays: add a 3D page (`write_replay`) next to the videos of the best, median
            and worst episodes. It is loaded only when opened.
        verifications: outputs from `mjrec verify --json`. A `verification.json` in a
            directory is found automatically.
        on_progress: called with a `ReportProgress` for each poster, video and replay.

    Raises:
        InvalidArgument: a directory has no recordings, `path` exists and is not a
            report, the page alone is larger than `max_single_file_bytes`, or `replays`
            and `single_file` are combined.
        UnreadableFile: a file in `verifications` cannot be read.
        MissingDependency: Jinja2, or viser for replays, is not installed.
        FileNotWritten, DirectoryNotWritable: the disk is full or read-only.
    """
    target = Path(os.path.realpath(path))
    is_page = target.suffix.lower() in _PAGE_ENDINGS
    if is_page and not single_file:
        raise InvalidArgument(
            f"{path} is a page's name, but a report is a folder. Pass a folder, or use "
            "a single file (single_file=True, --single-file)."
        )
    if replays and single_file:
        raise InvalidArgument(
            "Replays are separate pages next to the report. Write a folder "
            "(single_file=False, without --single-file)."
        )
    _check_target(target, is_page=is_page)
    tell = on_progress or (lambda progress: None)
    contents = gather(directories, title=title, verifications=verifications)
    for task in contents.tasks:
        if count := task.summary.not_finite:
            what = counted(count, "return")
            logger.warning("NaN or infinite: %s of %r.", what, task.name)
    media.add_images(contents, tell)
    if single_file:
        page = _single_page(contents, max_single_file_bytes)
        if is_page:
            make_directory(target.parent)
            write_text(target, page)
            return Path(path)
    with _replacing_folder(target) as folder:
        if not single_file:
            media.copy_videos(contents, folder, tell)
            if replays:
                media.write_replays(contents, folder, tell)
            page = page_of(contents)
        write_text(folder / PAGE_NAME, page)
    return Path(path) / PAGE_NAME


def _single_page(contents: ReportContents, most_bytes: int) -> str:
    room = most_bytes
    while True:
        page = page_of(media.with_embedded_videos(contents, room=room))
        size = len(page.encode())
        if size <= most_bytes:
            return page
        if room <= 0:
            raise InvalidArgument(
                f"The page has {size} bytes without any image or video, but "
                f"max_single_file_bytes allows only {most_bytes}. Raise the limit, or "
                "write a folder."
            )
        # The page also contains text, so reduce the room for videos by the excess.
        room -= size - most_bytes


def _check_target(target: Path, *, is_page: bool) -> None:
    """Raise InvalidArgument if the target exists and must not be replaced."""
    if not os.path.lexists(target):
        return
    if is_page:
        if not _is_own_page(target):
            raise InvalidArgument(
                f"{target} exists and is not a report, so it is not replaced. Choose a "
                "different name, or remove it."
            )
        return
    if not target.is_dir():
        raise InvalidArgument(
            f"{target} is a file, but a report is a folder. Choose a different name."
        )
    names = {entry.name for entry in target.iterdir()}
    if not names:
        return
    foreign = sorted(names - {PAGE_NAME, *_FOLDERS}) + sorted(
        f"{folder}/{entry.name}"
        for folder in _FOLDERS
        if (target / folder).is_dir()
        for entry in (target / folder).iterdir()
        if not media.is_own_name(entry.name)
    )
    if not _is_own_page(target / PAGE_NAME):
        foreign = sorted(names)
    if foreign:
        raise InvalidArgument(
            f"{target} contains files that do not belong to a report: "
            f"{listed(foreign, _SHOWN)}. It is not replaced. Choose a "
            "different folder, or move them away."
        )


def _is_own_page(path: Path) -> bool:
    try:
        with open_regular(path) as file:
            return _GENERATOR.search(file.read(_BEGIN)) is not None
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def _replacing_folder(target: Path) -> Iterator[Path]:
    """Yield a new folder next to `target`; replace `target` with it after the block.

    If the block raises an error, the new folder is removed and `target` is unchanged.
    """
    make_directory(target.parent)
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
            target, error.strerror, then="then run the same command again"
        ) from error
    finally:
        if before.exists() and not target.exists():
            before.rename(target)
        for left in (folder, before):
            shutil.rmtree(left, ignore_errors=True)

# SPDX-License-Identifier: Apache-2.0
"""Second names of videos, such as `rl-video-episode-27.mp4`.

The metadata of an episode's first video contains its second name (`also_named`). The
name is a link in the same directory. The link is created last, so that it never points
to an incomplete video. The episode's other videos, and the metadata of each video, get
second names too.

If a different file has such a name, it belongs to another program, and is neither
replaced nor removed.
"""

from __future__ import annotations

import contextlib
import filecmp
import itertools
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from .monitor_directory import (
    episode_of,
    is_second_name,
    iter_monitor_files,
    second_name_of,
)
from .video_metadata import finished_videos, metadata_of, metadata_path

logger = logging.getLogger(__name__)


def give_all_second_names(directory: Path) -> None:
    """Create any missing second names for the videos in a directory.

    Failures are logged as warnings.
    """
    for path in iter_monitor_files(directory):
        if path.name.endswith(".mp4") and metadata_path(path).exists():
            give_second_names(path)


def give_second_names(video: Path) -> None:
    """Create any second names for a finished video and its related files.

    If another file has such a name, or a link cannot be created, a warning is logged.

    Args:
        video: the first video of an episode. Its other videos have no second name of
            their own.
    """
    for file, link in _second_names(video):
        try:
            _link(file, link)
        except OSError as error:
            logger.warning("%s could not be linked as %s: %s.", file.name, link, error)


def take_second_names(video: Path) -> None:
    """Remove the second names of a video and its related files.

    Call this before replacing or removing any of these files.

    Args:
        video: the first video of an episode.

    Raises:
        OSError: a link cannot be removed.
    """
    for file, link in _second_names(video):
        if _is_same(file, link):
            link.unlink()


def _second_names(video: Path) -> Iterator[tuple[Path, Path]]:
    """Yield each file of an episode that has a second name, and the second path."""
    second = _said_of(video)
    if second is None:
        return
    for name in itertools.chain.from_iterable(finished_videos(video)):
        link = second_name_of(name, second, first=video.name)
        file = video.with_name(name)
        # A file that is itself a link may point anywhere.
        if link is not None and file.is_file() and not file.is_symlink():
            yield file, video.with_name(link)


def _said_of(video: Path) -> str | None:
    """Return the second name in a video's metadata, which is untrusted."""
    if video.suffix != ".mp4" or episode_of(video.name) is None:
        return None
    name = metadata_of(video).get("also_named")
    return name if isinstance(name, str) and is_second_name(name) else None


def _link(file: Path, link: Path) -> None:
    if os.path.lexists(link):
        if not _is_same(file, link):
            logger.warning(
                "%s already exists and is not the same file as %s, which should also "
                "have that name. It is left alone. Use a different name_prefix for "
                "each monitor in a directory.",
                link,
                file.name,
            )
        return
    # Another process may have created the link first.
    with contextlib.suppress(FileExistsError):
        try:
            link.hardlink_to(file)
        except FileExistsError:
            raise
        except OSError:
            link.symlink_to(file.name)


def _is_same(file: Path, link: Path) -> bool:
    """Return whether a name is a link to a file, or a copy of it.

    If a directory is copied without its hard links, they become separate files.
    """
    try:
        return link.samefile(file) or filecmp.cmp(file, link, shallow=False)
    except OSError:
        return False

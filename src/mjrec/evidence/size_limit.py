# SPDX-License-Identifier: Apache-2.0
"""Size limits for archives: videos are rerendered smaller until the archive fits.

All frames are rendered from the recorded states, and the new videos get their own
metadata and hashes. An encoded video is never re-encoded: videos that were rendered
live or have no recorded states stay unchanged.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..errors import ArchiveTooLarge, InvalidArgument, PackError
from ..formats.json_fields import read_object, unreadable
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import episode_of, infix_of, is_manifest
from ..formats.spans import find_trajectory
from ..formats.video_metadata import metadata_path
from ..machine import usable_cpus
from ..rendering.jobs import Progress, Variant, View
from ..rendering.pool import WorkerPool
from ..rendering.render_video import render_video
from .bag import STORED

# Scales of width and height, tried in order until the archive is small enough.
_SCALES = (Fraction(3, 4), Fraction(1, 2), Fraction(3, 8), Fraction(1, 4))
# Maximum number of files listed in an ArchiveTooLarge error.
_LARGEST = 10

_SIZE = re.compile(r"(\d{1,15}(?:\.\d{1,6})?)\s*(?:([KMGT])(i?))?B?", re.IGNORECASE)
_UNITS = ("", "K", "M", "G", "T")

# A video that can be rerendered: its file, its states and its metadata.
_Redrawable = tuple[Path, Path, dict[str, Any]]


def byte_count(size: int | str) -> int:
    """Return a size in bytes.

    K, M, G and T are powers of 1000, as in most upload limits; Ki, Mi, Gi and Ti are
    powers of 1024.

    >>> byte_count("50M"), byte_count("1.5 KiB"), byte_count(7)
    (50000000, 1536, 7)

    Raises:
        InvalidArgument: the size is invalid or below one byte.
    """
    match = _SIZE.fullmatch(size.strip()) if isinstance(size, str) else None
    try:
        if match is not None:
            number, unit, binary = match.groups(default="")
            base = 1024 if binary else 1000
            count = int(Fraction(number) * base ** _UNITS.index(unit.upper()))
        else:
            count = 0 if isinstance(size, bool) else operator.index(size)  # type: ignore[arg-type]  # a string is an error
    except TypeError:
        count = 0
    if count < 1:
        raise InvalidArgument(
            "max_size must be a number of bytes, or a string such as '50M' (millions) "
            f"or '50Mi' (multiples of 1024 * 1024), got {size!r}."
        )
    return count


def shown_size(size: int) -> str:
    """Return a number of bytes in human-readable form.

    >>> shown_size(52_345_678), shown_size(999)
    ('52.3 MB', '999 bytes')
    """
    for power in range(len(_UNITS) - 1, 0, -1):
        if size >= 1000**power:
            return f"{size / 1000**power:.3g} {_UNITS[power].replace('K', 'k')}B"
    return f"{size} bytes"


def shrinking(
    limit: int,
    staged: Path,
    archive: Path,
    *,
    on_progress: Callable[[Progress], object],
) -> Iterator[None]:
    """Yield whenever an archive must be made, and shrink videos until it fits.

    Args:
        limit: maximum size of the archive in bytes.
        staged: the folder with the recordings to pack.
        archive: the archive to make from them.
        on_progress: called with the progress of rerendering.

    Raises:
        ArchiveTooLarge: even the smallest archive is too large.
        PackError: a rerendered video has different frames from the recorded one.
    """
    size = yield from _attempt(limit, staged, archive)
    if size <= limit:
        return
    videos = _redrawable(staged)
    drawn = sum(video.stat().st_size for video, _, _ in videos)
    rest = size - drawn
    with WorkerPool(usable_cpus()) as workers:
        for scale in _SCALES if videos and rest < limit else ():
            # Skip this scale: videos do not shrink by more than their frames.
            if rest + drawn * scale**2 > limit and scale is not _SCALES[-1]:
                continue
            _draw_all(videos, scale, workers=workers, on_progress=on_progress)
            size = yield from _attempt(limit, staged, archive)
            if size <= limit:
                return
    largest = sorted(_sizes(staged), key=lambda item: (-item[1], item[0]))[:_LARGEST]
    reason = "Its videos already have a quarter of their width and height."
    if not videos:
        reason = (
            "None of its videos can be rerendered smaller: they have no recorded "
            "states, and encoded videos are never re-encoded."
        )
    elif rest >= limit:
        reason = f"The files that cannot be made smaller already take {rest} bytes."
    raise ArchiveTooLarge(size, limit, largest, reason=reason)


def _attempt(limit: int, staged: Path, archive: Path) -> Generator[None, None, int]:
    """Yield to make an archive unless it is certainly too large; return its size."""
    # Files that the archive stores uncompressed.
    least = sum(size for name, size in _sizes(staged) if name.endswith(STORED))
    if least > limit:
        return least
    yield
    return archive.stat().st_size


def _sizes(staged: Path) -> list[tuple[str, int]]:
    return [(path.name, path.stat().st_size) for path in staged.iterdir()]


def _redrawable(staged: Path) -> list[_Redrawable]:
    """Return the videos that can be rerendered from recorded states."""
    found = []
    manifests = [path for path in sorted(staged.iterdir()) if is_manifest(path.name)]
    videos = [pair for path in manifests for pair in read_manifest(path).videos]
    for video, metadata in videos:
        with unreadable(staged / metadata):
            said = dict(read_object(staged / metadata))
        infix, number = infix_of(video), episode_of(video)
        # The states of a clip are deleted once its video exists.
        if said.get("recording") == "deferred" and "first_step" not in said:
            assert infix is not None
            assert number is not None
            trajectory = find_trajectory(staged, infix, number)
            if trajectory is not None:
                found.append((staged / video, trajectory, said))
    return found


def _draw_all(
    videos: list[_Redrawable],
    scale: Fraction,
    *,
    workers: WorkerPool,
    on_progress: Callable[[Progress], object],
) -> None:
    """Replace videos and their metadata with smaller ones."""
    frames = sum(int(said["frame_count"]) for _, _, said in videos)
    now = Progress(videos=len(videos), frames=frames)

    def count_frame() -> None:
        nonlocal now
        now = replace(now, frames_done=now.frames_done + 1)
        on_progress(now)

    on_progress(now)
    for number, (video, trajectory, said) in enumerate(videos, 1):
        render_video(
            [trajectory],
            Variant(view=_view(said, scale)),
            workers=workers,
            out=video,
            on_frame=count_frame,
        )
        _amend(video, said)
        now = replace(now, videos_done=number)
        on_progress(now)


def _amend(video: Path, said: dict[str, Any]) -> None:
    """Complete a smaller video's metadata with values from the recorded video's."""
    with unreadable(metadata_path(video)):
        drawn = read_object(metadata_path(video))
    for key in ("frame_count", "frame_steps", "fps"):
        if drawn.get(key) != said.get(key):
            raise PackError(
                f"{video.name} changed when it was rerendered smaller: its "
                f"{key} was {said.get(key)!r:.100} and is {drawn.get(key)!r:.100}. "
                "Allow a larger archive."
            )
    metadata = {
        **said,
        **drawn,
        # The renderer does not know the name of an additional camera.
        "camera": said.get("camera"),
        "packed_smaller": {"from": [said["height"], said["width"]]},
    }
    write_text(metadata_path(video), json_text.dumps(metadata))


def _view(said: dict[str, Any], scale: Fraction) -> View:
    height, width = int(said["height"]), int(said["width"])
    if said.get("tiled"):
        height, width = height // int(said["rows"]), width // int(said["columns"])
    height, width = (max(2, 2 * round(side * scale / 2)) for side in (height, width))
    # The first camera and tiled videos are rendered with the recorded cameras.
    camera = said.get("camera") if "first_video" in said else None
    return View(camera=camera, height=height, width=width)

# SPDX-License-Identifier: Apache-2.0
"""Archives that may not be larger than allowed: their videos are drawn again smaller.

They are drawn from the recorded states, every frame of them, and get metadata and
hashes of their own. A video that was encoded is never encoded again: what was drawn
live, or has no recorded states, stays as it is.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..errors import ArchiveTooLarge, InvalidArgument, PackError
from ..formats.json_fields import read_object, unreadable
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import Infix, episode_of, infix_of, is_manifest
from ..formats.spans import find_trajectory
from ..formats.video_metadata import metadata_path
from ..machine import usable_cpus
from ..rendering.jobs import Progress
from ..rendering.pool import WorkerPool
from ..rendering.render_video import render_video
from ..rendering.views import Variant, View
from .bag import STORED

# Of width and height, one after the other until the archive is small enough.
_SCALES = (Fraction(3, 4), Fraction(1, 2), Fraction(3, 8), Fraction(1, 4))
# Of the files that an archive that is too large is made of.
_LARGEST = 10

_SIZE = re.compile(r"(\d{1,15}(?:\.\d{1,6})?)\s*(?:([KMGT])(i?))?B?", re.IGNORECASE)
_UNITS = ("", "K", "M", "G", "T")


def byte_count(size: int | str) -> int:
    """Return a size in bytes.

    K, M, G and T are powers of 1000, as those who limit uploads count; Ki, Mi, Gi and
    Ti are powers of 1024.

    >>> byte_count("50M"), byte_count("1.5 KiB"), byte_count(7)
    (50000000, 1536, 7)

    Raises:
        InvalidArgument: it is no size, or less than a byte.
    """
    match = _SIZE.fullmatch(size.strip()) if isinstance(size, str) else None
    try:
        if match is not None:
            number, unit, binary = match.groups(default="")
            base = 1024 if binary else 1000
            count = int(Fraction(number) * base ** _UNITS.index(unit.upper()))
        else:
            count = 0 if isinstance(size, bool) else operator.index(size)  # type: ignore[arg-type]  # a text is an error
    except TypeError:
        count = 0
    if count < 1:
        raise InvalidArgument(
            "max_size is a number of bytes, or a text such as '50M' (a million each) "
            f"or '50Mi' (1024 * 1024 each), got {size!r}."
        )
    return count


def shown_size(size: int) -> str:
    """Return a number of bytes as people read it.

    >>> shown_size(52_345_678), shown_size(999)
    ('52.3 MB', '999 bytes')
    """
    for power in range(len(_UNITS) - 1, 0, -1):
        if size >= 1000**power:
            return f"{size / 1000**power:.3g} {_UNITS[power].replace('K', 'k')}B"
    return f"{size} bytes"


@dataclass(frozen=True, kw_only=True)
class _Redrawable:
    """A video that can be drawn again: its file, its states and its metadata."""

    video: Path
    trajectory: Path
    said: dict[str, Any]


def archive_within(
    limit: int,
    staged: Path,
    *,
    make: Callable[[], Path],
    on_progress: Callable[[Progress], object],
) -> Path:
    """Return an archive of at most `limit` bytes, with smaller videos if need be.

    Args:
        limit: the most bytes.
        staged: the recordings that are to be packed.
        make: packs them, as they then are, and returns the archive.
        on_progress: told how far the drawing is.

    Raises:
        ArchiveTooLarge: there can be none.
        PackError: a video came out with other frames than it was recorded with.
    """

    def attempt() -> tuple[Path | None, int]:
        # What will stand in it as it is.
        least = sum(s for name, s in _sizes(staged) if name.endswith(STORED))
        if least > limit:
            return None, least
        archive = make()
        size = archive.stat().st_size
        return (archive if size <= limit else None), size

    archive, size = attempt()
    if archive is not None:
        return archive
    videos = _redrawable(staged)
    drawn = sum(each.video.stat().st_size for each in videos)
    rest = size - drawn
    with WorkerPool(usable_cpus()) as workers:
        for scale in _SCALES if videos and rest < limit else ():
            # No video shrinks more than its frames do: there is no use in trying.
            if rest + drawn * scale**2 > limit and scale is not _SCALES[-1]:
                continue
            _draw_all(videos, scale, workers=workers, on_progress=on_progress)
            archive, size = attempt()
            if archive is not None:
                return archive
    largest = sorted(_sizes(staged), key=lambda item: (-item[1], item[0]))[:_LARGEST]
    reason = _why_too_large(bool(videos), rest, limit)
    raise ArchiveTooLarge(size, limit, largest, reason=reason)


def _sizes(staged: Path) -> list[tuple[str, int]]:
    return [(path.name, path.stat().st_size) for path in staged.iterdir()]


def _why_too_large(can_draw: bool, rest: int, limit: int) -> str:
    if not can_draw:
        return (
            "No video in it can be drawn again smaller: there are no recorded states "
            "of them, and what is encoded is never encoded again."
        )
    if rest >= limit:
        return f"All that could not be made smaller has {rest} bytes already."
    return "That is with videos of a quarter of width and height."


def _redrawable(staged: Path) -> list[_Redrawable]:
    """Return the videos that can be drawn again from recorded states."""
    found = []
    manifests = [path for path in sorted(staged.iterdir()) if is_manifest(path.name)]
    for video, metadata in (
        v for path in manifests for v in read_manifest(path).videos
    ):
        with unreadable(staged / metadata):
            said = dict(read_object(staged / metadata))
        infix, number = Infix.parse(infix_of(video) or ""), episode_of(video)
        # The states of a clip are gone when its video is there.
        if said.get("recording") == "deferred" and "first_step" not in said:
            assert infix is not None
            assert number is not None
            trajectory = find_trajectory(staged, infix, number)
            if trajectory is not None:
                found.append(
                    _Redrawable(video=staged / video, trajectory=trajectory, said=said)
                )
    return found


def _draw_all(
    videos: list[_Redrawable],
    scale: Fraction,
    *,
    workers: WorkerPool,
    on_progress: Callable[[Progress], object],
) -> None:
    """Put smaller videos in the place of these, with all that is said about them."""
    frames = sum(int(each.said["frame_count"]) for each in videos)
    now = Progress(videos=len(videos), frames=frames)

    def count_frame() -> None:
        nonlocal now
        now = replace(now, frames_done=now.frames_done + 1)
        on_progress(now)

    on_progress(now)
    for number, video in enumerate(videos, 1):
        _draw(video, scale, workers=workers, on_frame=count_frame)
        now = replace(now, videos_done=number)
        on_progress(now)


def _draw(
    redrawn: _Redrawable,
    scale: Fraction,
    *,
    workers: WorkerPool,
    on_frame: Callable[[], object],
) -> None:
    video, said = redrawn.video, redrawn.said
    render_video(
        [redrawn.trajectory],
        Variant(view=_view(said, scale)),
        workers=workers,
        out=video,
        on_frame=on_frame,
    )
    with unreadable(metadata_path(video)):
        drawn = read_object(metadata_path(video))
    for key in ("frame_count", "frame_steps", "fps"):
        if drawn.get(key) != said.get(key):
            raise PackError(
                f"{video.name} came out otherwise when it was drawn smaller: its "
                f"{key} was {said.get(key)!r:.100} and is {drawn.get(key)!r:.100}. "
                "Allow a larger archive."
            )
    metadata = {
        **said,
        **drawn,
        # Of a further camera the drawing does not know what it is called.
        "camera": said.get("camera"),
        "packed_smaller": {"from": [said["height"], said["width"]]},
    }
    write_text(metadata_path(video), json_text.dumps(metadata))


def _view(said: dict[str, Any], scale: Fraction) -> View:
    height, width = int(said["height"]), int(said["width"])
    if said.get("tiled"):
        height, width = height // int(said["rows"]), width // int(said["columns"])
    return View(
        # The first camera, and all of them side by side, are drawn as recorded.
        camera=said.get("camera") if "first_video" in said else None,
        height=_even(height * scale),
        width=_even(width * scale),
    )


def _even(side: Fraction) -> int:
    return max(2, 2 * round(side / 2))

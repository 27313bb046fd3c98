# SPDX-License-Identifier: Apache-2.0
"""Archives that may not be larger than somebody allows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ...errors import ArchiveTooLarge
from ...machine import usable_cpus
from ...rendering.jobs import Progress
from ...rendering.pool import WorkerPool
from .assembly import Assembly
from .smaller_videos import SCALES, draw_smaller, redrawable

# Of the files that an archive that is too large is made of.
_LARGEST = 10


def archive_within(
    limit: int, assembly: Assembly, *, on_progress: Callable[[Progress], object]
) -> Path:
    """Return an archive of at most `limit` bytes, with smaller videos if need be.

    Raises:
        ArchiveTooLarge: there can be none.
    """
    archive, size = assembly.archive_within(limit)
    if archive is not None:
        return archive
    videos = redrawable(assembly.contents.videos)
    drawn = sum(video.video.stat().st_size for video in videos)
    rest = size - drawn
    with WorkerPool(usable_cpus()) as workers:
        for scale in SCALES if videos and rest < limit else ():
            # No video shrinks more than its pictures do: there is no use in trying.
            if rest + drawn * scale**2 > limit and scale is not SCALES[-1]:
                continue
            draw_smaller(
                videos,
                assembly.staged,
                scale,
                workers=workers,
                on_progress=on_progress,
            )
            archive, size = assembly.archive_within(limit)
            if archive is not None:
                return archive
    raise ArchiveTooLarge(
        size,
        limit,
        sorted(assembly.sizes(), key=lambda item: (-item[1], item[0]))[:_LARGEST],
        reason=_why_too_large(bool(videos), rest, limit),
    )


def _why_too_large(can_draw: bool, rest: int, limit: int) -> str:
    if not can_draw:
        return (
            "No video in it can be drawn again smaller: there are no recorded states "
            "of them, and what is encoded is never encoded again."
        )
    if rest >= limit:
        return f"All that could not be made smaller has {rest} bytes already."
    return "That is with videos of a quarter of width and height."

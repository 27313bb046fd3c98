# SPDX-License-Identifier: Apache-2.0
"""Videos drawn again smaller, so that an archive stays within a limit.

They are drawn from the recorded states, every frame of them, and get metadata and
hashes of their own. A video that was encoded is never encoded again: what was drawn
live, or has no recorded states, stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from ... import json_text
from ...atomic_files import write_text
from ...errors import PackError
from ...formats.json_fields import read_object, unreadable
from ...formats.video_metadata import metadata_path
from ...rendering.jobs import Progress
from ...rendering.pool import WorkerPool
from ...rendering.render_video import render_video
from ...rendering.views import Variant, View
from .contents import VideoFiles

# Of width and height, one after the other until the archive is small enough.
SCALES = (Fraction(3, 4), Fraction(1, 2), Fraction(3, 8), Fraction(1, 4))


@dataclass(frozen=True, kw_only=True)
class Redrawable:
    """A video that can be drawn again.

    Attributes:
        video: the file.
        trajectory: what it is drawn from.
        metadata: what is said of it.
    """

    video: Path
    trajectory: Path
    metadata: Mapping[str, Any]

    @property
    def frame_count(self) -> int:
        """How many frames it has."""
        return int(self.metadata["frame_count"])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its pictures."""
        return int(self.metadata["height"]), int(self.metadata["width"])


def redrawable(videos: Iterable[VideoFiles]) -> list[Redrawable]:
    """Return those of the videos that can be drawn again from recorded states.

    Raises:
        UnreadableFile: the metadata of one is damaged.
    """
    found = []
    for files in videos:
        with unreadable(files.metadata):
            metadata = read_object(files.metadata)
        # The states of one that is counted in steps are gone when it is there.
        if (
            files.trajectory is not None
            and metadata.get("recording") == "deferred"
            and "first_step" not in metadata
        ):
            found.append(
                Redrawable(
                    video=files.video,
                    trajectory=files.trajectory,
                    metadata=metadata,
                )
            )
    return found


def draw_smaller(
    videos: Iterable[Redrawable],
    folder: Path,
    scale: Fraction,
    *,
    workers: WorkerPool,
    on_progress: Callable[[Progress], object],
) -> None:
    """Put smaller videos in the place of those in `folder`, with all about them.

    Args:
        videos: which; they stay as they are.
        folder: where the smaller ones get their names.
        scale: of width and height; both become even.
        workers: who draw.
        on_progress: called after every frame.

    Raises:
        PackError: a video came out with other frames than it was recorded with.
        Error: its frames cannot be drawn or encoded here.
    """
    wanted = list(videos)
    now = Progress(
        videos=len(wanted), frames=sum(video.frame_count for video in wanted)
    )

    def count_frame() -> None:
        nonlocal now
        now = replace(now, frames_done=now.frames_done + 1)
        on_progress(now)

    on_progress(now)
    for number, video in enumerate(wanted, 1):
        _draw(video, folder, scale, workers=workers, on_frame=count_frame)
        now = replace(now, videos_done=number)
        on_progress(now)


def _draw(
    video: Redrawable,
    folder: Path,
    scale: Fraction,
    *,
    workers: WorkerPool,
    on_frame: Callable[[], object],
) -> None:
    out = folder / video.video.name
    render_video(
        [video.trajectory],
        Variant(view=_view(video, scale)),
        workers=workers,
        out=out,
        on_frame=on_frame,
    )
    with unreadable(metadata_path(out)):
        drawn = read_object(metadata_path(out))
    for key in ("frame_count", "frame_steps", "fps"):
        if drawn.get(key) != video.metadata.get(key):
            raise PackError(
                f"{video.video.name} came out otherwise when it was drawn smaller: its "
                f"{key} was {video.metadata.get(key)!r:.100} and is "
                f"{drawn.get(key)!r:.100}. Allow a larger archive."
            )
    metadata = {
        **video.metadata,
        **drawn,
        # Of a further camera the drawing does not know what it is called.
        "camera": video.metadata.get("camera"),
        "packed_smaller": {"from": list(video.size)},
    }
    write_text(metadata_path(out), json_text.dumps(metadata))


def _view(video: Redrawable, scale: Fraction) -> View:
    height, width = video.size
    said = video.metadata
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

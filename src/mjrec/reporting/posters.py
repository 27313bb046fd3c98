# SPDX-License-Identifier: Apache-2.0
"""The picture that stands for a video until it is played."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ..errors import Error
from .video_stream import jpeg_at, read_stream

_MOST_WIDTH: Final = 640


@dataclass(frozen=True)
class Poster:
    """A picture of a video.

    Attributes:
        jpeg: the picture; None where the video cannot be decoded.
        seconds: how long the video plays; None where that cannot be told.
        problem: why there is no picture; None where there is one.
    """

    jpeg: bytes | None
    seconds: float | None
    problem: str | None = None


def poster_of(video: Path) -> Poster:
    """Return the picture in the middle of a video, at most 640 pixels wide.

    The first one is often a robot in its initial pose, alike in all videos of a task,
    and the last one a fall; what happens is in between.
    """
    seconds = None
    try:
        stream = read_stream(video)
        seconds = stream.seconds
        middle = float(stream.times[(len(stream) - 1) // 2])
        jpeg = jpeg_at(stream, middle, most_width=_MOST_WIDTH)
    except Error as error:
        return Poster(None, seconds, str(error))
    if not jpeg:
        return Poster(None, seconds, f"The video {video.name} cannot be decoded.")
    return Poster(jpeg, seconds)

# SPDX-License-Identifier: Apache-2.0
"""A small animated picture of a finished video, for pages that play no videos."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

from ..formats.ffmpeg import run_ffmpeg

_MOST_BYTES = 2 << 20
# Of the longer side, in pixels. The last is small enough for any hundred pictures.
_SIDES = (320, 160, 80)
_MOST_PICTURES = 100
# In hundredths of a second, the format's unit.
_SHORTEST_DELAY = 5
# So many frames hold forty key frames and more, which are decoded in no time.
_MANY_FRAMES = 10_000


def animated_gif(path: Path, *, frame_count: int, fps: Fraction) -> bytes:
    """Return a video as a GIF of at most 100 pictures and two megabytes.

    It lasts as long as the video, and is played again and again; a long one shows few
    pictures a second. The longer side has 320 pixels at most.

    Args:
        path: the video.
        frame_count: how many frames it has.
        fps: how many a second.

    Raises:
        EncoderError: ffmpeg failed, or hangs.
    """
    delay = _delay(frame_count, fps)
    for side in _SIDES:
        gif = _convert(path, side=side, delay=delay, frame_count=frame_count)
        if len(gif) <= _MOST_BYTES:
            break
    return gif


def _delay(frame_count: int, fps: Fraction) -> int:
    longest = math.ceil(100 * frame_count / fps / _MOST_PICTURES)
    return max(_SHORTEST_DELAY, math.ceil(100 / fps), longest)


def _convert(path: Path, *, side: int, delay: int, frame_count: int) -> bytes:
    skipping = ["-skip_frame", "nokey"] if frame_count >= _MANY_FRAMES else []
    # A palette of the video's own, of which only what changes is stored.
    filters = (
        # Up, so that even the shortest video has a picture.
        f"fps=100/{delay}:round=up,"
        f"scale=min(iw\\,{side}):min(ih\\,{side})"
        ":force_original_aspect_ratio=decrease:flags=area,"
        "split[pictures][counted];[counted]palettegen=stats_mode=diff[palette];"
        "[pictures][palette]paletteuse=dither=bayer:bayer_scale=4:diff_mode=rectangle"
    )
    return run_ffmpeg(
        [
            *("-hide_banner", "-loglevel", "error", "-nostdin"),
            *(*skipping, "-threads", "1", "-i", f"file:{path}"),
            *("-an", "-filter_complex", filters, "-frames:v", str(_MOST_PICTURES)),
            *("-loop", "0", "-f", "gif", "pipe:1"),
        ],
        what=f"No preview could be made of {path}.",
    )

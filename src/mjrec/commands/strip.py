# SPDX-License-Identifier: Apache-2.0
"""`mjrec strip`: put frames of an episode side by side, for a paper."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..reporting.film_strips import film_strip, write_film_strip
from .options import AsJson, camera_of, size_of
from .terminal import print_json


def strip(
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("strip.png"),
    frames: int = 8,
    size: str | None = None,
    camera: str | None = None,
    columns: int | None = None,
    quality: Literal["full", "draft"] | None = None,
    as_json: AsJson = False,
) -> int:
    """Put frames of an episode side by side, with their times.

    Frames are evenly spaced and include the first and the last. They are rendered from
    a trajectory, at any size and from any camera, or decoded from a video.

    Args:
        file: a trajectory (openaigym.trajectory.*.h5) or a video.
        out: the PNG to write.
        frames: number of frames.
        size: WIDTHxHEIGHT of each frame in pixels (trajectories only).
        camera: name or number (trajectories only). Default: as recorded.
        columns: frames per row. Default: up to eight.
        quality: full (the model's own settings) or draft (trajectories only).
        as_json: print one JSON object at the end.
    """
    height, width = size_of(size)
    frame = film_strip(
        file,
        frames=frames,
        columns=columns,
        camera=camera_of(camera),
        height=height,
        width=width,
        quality=quality,
    )
    write_film_strip(out, frame)
    shown = {"strip": str(out), "width": frame.shape[1], "height": frame.shape[0]}
    if as_json:
        print_json(shown)
    else:
        sys.stdout.write(f"{out}: {shown['width']}x{shown['height']} pixels\n")
    return 0

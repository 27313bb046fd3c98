# SPDX-License-Identifier: Apache-2.0
"""`mjrec strip`: some pictures of an episode side by side, for a paper."""

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
    frames: int = 8,
    columns: int | None = None,
    camera: str | None = None,
    size: str | None = None,
    quality: Literal["full", "draft"] | None = None,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("strip.png"),
    as_json: AsJson = False,
) -> int:
    """Make a film strip: pictures of an episode side by side, with their times.

    They are evenly spread, the first and the last one included. From a trajectory they
    are drawn again, of any size and from any camera, as sharp as they were rendered;
    from a video they are decoded.

    Args:
        file: a trajectory (openaigym.trajectory.*.h5) or a video.
        frames: how many pictures.
        columns: how many side by side; all of up to eight, if it is not given.
        camera: of a trajectory: name or number; as recorded, if it is not given.
        size: of a trajectory: WIDTHxHEIGHT of each picture in pixels.
        quality: of a trajectory: full, the model's own settings, or draft.
        out: the PNG to write.
        as_json: print one JSON object at the end.
    """
    height, width = size_of(size)
    picture = film_strip(
        file,
        frames=frames,
        columns=columns,
        camera=camera_of(camera),
        height=height,
        width=width,
        quality=quality,
    )
    write_film_strip(out, picture)
    shown = {"strip": str(out), "width": picture.shape[1], "height": picture.shape[0]}
    if as_json:
        print_json(shown)
    else:
        sys.stdout.write(f"{out}: {shown['width']}x{shown['height']} pixels\n")
    return 0

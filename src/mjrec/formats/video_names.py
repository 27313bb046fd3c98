# SPDX-License-Identifier: Apache-2.0
"""The names of an episode's videos besides its first.

::

    openaigym.video.<infix>.video000027.mp4             the first camera's
    openaigym.video.<infix>.video000027.step000137.mp4  of one that a step began
    openaigym.video.<infix>.video000027.side.mp4        a further camera's
    openaigym.video.<infix>.video000027.camera2.mp4     of one that has no name
    openaigym.video.<infix>.video000027.tiled.mp4       all sub-environments' in one
    openaigym.video.<infix>.video000027.side.640x480.mp4    rendered again
    rl-video-episode-27.mp4                             another name of the first ...
    rl-video-episode-27.side.mp4                        ... and of a further one

What tells them apart is a part of the name before its ending. A camera may be called
anything, so its part is made of its name such that it is no other part and never leads
out of the directory.
"""

from __future__ import annotations

import hashlib
import re
import urllib.parse
from collections.abc import Sequence
from typing import Any

from .monitor_directory import VideoName

_VIDEO = ".mp4"
_TILED = "tiled"

# Names of cameras that would be taken for another part of a file's name, or for none.
_AMBIGUOUS = re.compile(
    r"|full|draft|annotated|plain|tiled|meta|\d*x\d*|.*fps|(video|step)\d+"
    r"|camera(-.*|\d+)"
)
# Directories have names of 255 bytes, and there are other parts.
_LONGEST_PART = 80
_DIGEST = 8

# What Gymnasium's RecordVideo calls its files, for any `name_prefix` that is portable.
_SECOND_NAME = re.compile(
    r"(?!openaigym)[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}-(episode|step)-[0-9]{1,18}\.mp4",
    re.ASCII,
)


def name_part(text: str) -> str:
    """Return a text as a part of a file's name.

    Every character but letters, digits, `_` and `-` of ASCII is percent-encoded, as
    UTF-8. One that is too long for a name ends in a digest instead.
    """
    quoted = urllib.parse.quote(text, safe="", errors="surrogatepass")
    # What `quote` leaves alone and is no letter, digit, `_` or `-`.
    part = quoted.replace(".", "%2E").replace("~", "%7E")
    if len(part) <= _LONGEST_PART:
        return part
    digest = hashlib.sha256(part.encode()).hexdigest()[:_DIGEST]
    # No half of an encoded character.
    begin = re.sub("%.?$", "", part[: _LONGEST_PART - _DIGEST - 1])
    return f"{begin}-{digest}"


def camera_part(camera: Any) -> str:
    """Return the part of a file's name that stands for one camera.

    One whose name could be another part of a name is there as `camera-draft`.

    Args:
        camera: a name, a number, or the members of an `MjvCamera`.
    """
    if isinstance(camera, int):
        return str(camera)
    part = name_part(str(camera))
    return f"camera-{part}" if _AMBIGUOUS.fullmatch(part) else part


def further_parts(cameras: Sequence[Any]) -> list[str]:
    """Return the parts that stand for all cameras of an episode but the first.

    A camera that has no name is called by its place, `camera2` for the second of all.
    Where two would be the same, as of camera 1 and the camera "1", the later one gets
    `-2`, `-3` and so on.

    Args:
        cameras: all of them, in their order.
    """
    parts: list[str] = []
    for place, camera in enumerate(cameras[1:], 2):
        has_name = isinstance(camera, str | int)
        part = camera_part(camera) if has_name else f"camera{place}"
        parts.append(_unlike(part, parts))
    return parts


def with_part(video: str, part: str) -> str:
    """Return the name of a video with a part before its ending.

    >>> with_part("rl-video-episode-27.mp4", "side")
    'rl-video-episode-27.side.mp4'
    """
    stem, dot, ending = video.rpartition(".")
    return f"{stem}.{part}{dot}{ending}"


def without_part(video: str) -> str:
    """Return the name of a video without the part before its ending.

    >>> without_part("rl-video-episode-27.side.mp4")
    'rl-video-episode-27.mp4'
    """
    stem, dot, ending = video.rpartition(".")
    return f"{stem.rpartition('.')[0]}{dot}{ending}"


def tiled_name(video: str) -> str:
    """Return the name of the video that shows all sub-environments at once.

    Args:
        video: the name that it would have otherwise.
    """
    return with_part(video, _TILED)


def view_of(video: str) -> str:
    """Return which of an episode's videos one is; empty for the first camera's.

    >>> view_of("openaigym.video.0.7.video000027.step000137.side.mp4")
    'side'
    """
    name = VideoName.parse(video)
    # One that was rendered again has more than a camera's part.
    return "" if name is None or "." in name.view else name.view


def is_second_name(name: str) -> bool:
    """Tell whether a video of ours may be called `name` besides its own name."""
    return _SECOND_NAME.fullmatch(name) is not None


def second_name_of(name: str, second: str, *, first: str) -> str | None:
    """Return the second name of a file that belongs to an episode.

    >>> second_name_of("v.side.meta.json", "rl-video-episode-2.mp4", first="v.mp4")
    'rl-video-episode-2.side.meta.json'

    Args:
        name: of the file.
        second: the second name of the episode's first video.
        first: the first name of that.

    Returns:
        None where the file is none of this episode.
    """
    stem = first.removesuffix(_VIDEO)
    if not name.startswith(f"{stem}."):
        return None
    return second.removesuffix(_VIDEO) + name.removeprefix(stem)


def _unlike(part: str, others: Sequence[str]) -> str:
    unlike, number = part, 1
    while unlike in others:
        number += 1
        unlike = f"{part}-{number}"
    return unlike

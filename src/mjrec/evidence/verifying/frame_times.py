# SPDX-License-Identifier: Apache-2.0
"""When a shipped video shows each of its frames, as its file says it.

Which frames a file holds says nothing of how fast it plays: the times stand beside
them, and can be changed without them. They are read exactly; the rate that ffmpeg
prints of a file is an estimate.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Generator
from fractions import Fraction
from pathlib import Path
from typing import Final

from ...errors import UnreadableFile
from ...formats.ffmpeg import FfmpegProcess, as_file
from ...formats.regular_files import regular_path

_READ_SIZE: Final = 1 << 16
_LONGEST_LINE: Final = 4096
_TIME_BASE: Final = re.compile(rb"#tb 0: (\d{1,10})/(\d{1,10})")
_PACKET: Final = re.compile(rb"0, *-?\d+, *(-?\d{1,19}), *(\d{1,19}),.*")


class UnevenTimes(Exception):
    """The frames of a video do not follow each other evenly.

    Its text is a clause about the video.
    """


def rate_of_frames(path: Path, *, most: int) -> Fraction:
    """Return how many frames a second a video shows, where each lasts as long.

    Args:
        path: of the mp4.
        most: how many frames it may have.

    Raises:
        UnevenTimes: the first does not come at once, or they last differently long, or
            there are more.
        UnreadableFile: it is no regular file, or says nothing of times.
        EncoderError: ffmpeg cannot read it.
        Error: ffmpeg cannot be started.
    """
    base, duration, shown = Fraction(0), 0, 0
    # In the file they stand in the order in which they are decoded.
    early: set[int] = set()
    with contextlib.closing(_lines(path)) as lines:
        for line in lines:
            if (found := _TIME_BASE.fullmatch(line)) and int(found[2]):
                base = Fraction(int(found[1]), int(found[2]))
            elif packet := _PACKET.fullmatch(line):
                time, lasts = int(packet[1]), int(packet[2])
                duration = duration or lasts
                if not lasts or lasts != duration or time % duration:
                    raise UnevenTimes("its frames are not shown equally long")
                early.add(time // duration)
                while shown in early:
                    early.remove(shown)
                    shown += 1
                if shown + len(early) > most:
                    raise UnevenTimes(f"it shows more than the {most} frames recorded")
    if early:
        raise UnevenTimes("its frames do not follow each other without a gap")
    if not shown or not base:
        raise UnreadableFile(path, "it does not say when its frames are shown")
    return 1 / (duration * base)


def _lines(path: Path) -> Generator[bytes, None, None]:
    """Yield what ffmpeg says of a video, packet by packet, without decoding them."""
    try:
        source = regular_path(path)
    except (OSError, ValueError) as error:
        raise UnreadableFile(path, error) from error
    arguments = [
        *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
        *("-protocol_whitelist", "file", "-f", "mp4", "-i", as_file(source)),
        *("-map", "0:v:0", "-c", "copy"),
        # As the file says them, not shifted so that the first is zero.
        *("-copyts", "-avoid_negative_ts", "disabled"),
        *("-f", "framecrc", "pipe:1"),
    ]
    what = f"When the frames of {path.name} are shown cannot be read."
    with FfmpegProcess(arguments, what=what, writes=True) as process:
        rest = b""
        while block := process.read(_READ_SIZE):
            *lines, rest = (rest + block).split(b"\n")
            yield from lines
            if len(rest) > _LONGEST_LINE:
                raise UnreadableFile(path, f"ffmpeg says {rest!r:.80} of it")
        process.wait()

# SPDX-License-Identifier: Apache-2.0
"""Reading of video files: stream facts and decoded frames.

imageio's ffmpeg reads a file only in the format that its first bytes indicate, and
opens no other files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..formats.ffmpeg import as_file, every_frame_arguments, run_ffmpeg
from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular, regular_path
from ..frames import Frame

_BEGIN: Final = 12
# ffmpeg's names for the formats, by suffix.
_KINDS: Final = {".mp4": "mp4", ".avi": "avi", ".mkv": "matroska"}

_HEADER: Final = re.compile(rb"^#(tb|dimensions) 0: (\d+)[/x](\d+)$", re.MULTILINE)
# Stream, decoding time, presentation time, duration, size, checksum.
_PACKET: Final = re.compile(rb"^0, *(-?\d+), *(-?\d+), *(\d+), .*$", re.MULTILINE)
# ffmpeg's value for a missing presentation time, as in AVI files.
_NO_TIME: Final = -(2**63)
# A crafted file may claim any size.
_MOST_PIXELS: Final = 16384 * 16384
# The maximum number of frames in memory.
_AT_ONCE: Final = 16


@dataclass(frozen=True)
class VideoStream:
    """The facts about a video's stream, without decoded frames.

    Attributes:
        path: the video file, which is not a link.
        height: height in pixels.
        width: width in pixels.
        times: `(n,) float64`, ascending: the time of each frame, in seconds after the
            first frame.
        seconds: duration in seconds.
    """

    path: Path
    height: int
    width: int
    times: NDArray[np.float64]
    seconds: float

    def __len__(self) -> int:
        return len(self.times)


def video_kind(path: Path) -> str | None:
    """Return the suffix for a file's first bytes; None if the format is unknown.

    Raises:
        UnreadableFile: the file cannot be read, or is not a regular file.
    """
    with unreadable(path), open_regular(path) as file:
        begin = file.read(_BEGIN)
    if begin[4:8] == b"ftyp":
        return ".mp4"
    if begin[:4] == b"RIFF" and begin[8:12] == b"AVI ":
        return ".avi"
    return ".mkv" if begin[:4] == b"\x1a\x45\xdf\xa3" else None


def read_stream(path: Path) -> VideoStream:
    """Return the facts about a video file's stream.

    Raises:
        UnreadableFile: the file is not a video, or has no frames.
        EncoderError: the file is damaged.
        Error: ffmpeg cannot be started.
    """
    arguments = [*_reading(path), "-c", "copy", "-f", "framecrc", "pipe:1"]
    output = run_ffmpeg(arguments, what=f"The video {path.name} cannot be read.")
    headers = {key: (int(a), int(b)) for key, a, b in _HEADER.findall(output)}
    # Packets come in decoding order; sort them by time.
    packets = sorted(
        (int(decoded if int(time) == _NO_TIME else time), int(duration))
        for decoded, time, duration in _PACKET.findall(output)
    )
    if not packets or len(headers) < 2 or not headers[b"tb"][1]:
        raise UnreadableFile(path, "it contains no frames")
    unit = float(Fraction(*headers[b"tb"]))
    width, height = headers[b"dimensions"]
    times = np.array([time for time, _ in packets], np.float64)
    times = (times - times[0]) * unit
    seconds = float(times[-1] + packets[-1][1] * unit)
    return VideoStream(regular_path(path), height, width, times, seconds)


def frames_at(
    stream: VideoStream, indices: Sequence[int], *, most_width: int | None = None
) -> Iterator[Frame]:
    """Yield decoded frames of a video, `(height, width, 3) uint8`.

    Args:
        stream: the stream from `read_stream`.
        indices: the numbers of the frames, ascending.
        most_width: maximum width in pixels; wider frames are scaled down.

    Raises:
        EncoderError: the video cannot be decoded up to these frames.
        UnreadableFile: the video has fewer frames than its packets indicate.
    """
    width, scale = stream.width, ""
    if most_width is not None and most_width < width:
        width, scale = most_width, f"scale={most_width}:-2:flags=area,"
    for begin in range(0, len(indices), _AT_ONCE):
        some = indices[begin : begin + _AT_ONCE]
        wanted = "+".join(rf"eq(n\,{index})" for index in some)
        data = run_ffmpeg(
            [
                *_reading(stream.path),
                *("-vf", f"select={wanted},{scale}format=rgb24"),
                *(*every_frame_arguments(), "-frames:v", str(len(some))),
                *("-f", "rawvideo", "pipe:1"),
            ],
            what=f"The video {stream.path.name} cannot be decoded.",
        )
        if not data or len(data) % (len(some) * width * 3):
            raise UnreadableFile(
                stream.path, f"it has fewer than the {len(stream)} frames it claims"
            )
        yield from np.frombuffer(data, np.uint8).reshape(len(some), -1, width, 3)


def _reading(path: Path) -> list[str]:
    """Return ffmpeg's arguments for reading a file."""
    kind = video_kind(path)
    if kind is None:
        raise UnreadableFile(path, "it is not a video in a supported format")
    with unreadable(path):
        source = as_file(regular_path(path))
    return [
        *("-hide_banner", "-loglevel", "error", "-nostdin"),
        *("-threads", "1", "-protocol_whitelist", "file,pipe"),
        *("-max_pixels", str(_MOST_PIXELS), "-noautorotate"),
        *("-f", _KINDS[kind], "-i", source, "-map", "0:v:0"),
    ]

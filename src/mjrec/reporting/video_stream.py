# SPDX-License-Identifier: Apache-2.0
"""What there is to be seen in the file of a video, and frames out of it.

ffmpeg (imageio's) reads a file as nothing but what its first bytes say that it is, and
opens no other file for it.
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
# By ending: what ffmpeg calls them.
_KINDS: Final = {".mp4": "mp4", ".avi": "avi", ".mkv": "matroska"}

_HEADER: Final = re.compile(rb"#(?P<key>tb|dimensions) 0: (?P<a>\d+)[/x](?P<b>\d+)")
# Stream, decoding time, presentation time, duration, size, checksum.
_PACKET: Final = re.compile(
    rb"0, *(?P<decoded>-?\d+), *(?P<time>-?\d+), *(?P<duration>\d+), .*"
)
# What stands where a file, such as an AVI, has no presentation times.
_NO_TIME: Final = -(2**63)
# A crafted file may claim any size.
_MOST_PIXELS: Final = 16384 * 16384
# How many frames are in memory.
_AT_ONCE: Final = 16


@dataclass(frozen=True)
class VideoStream:
    """The frames of a video, none of them decoded.

    Attributes:
        path: of the file, no link.
        height: in pixels.
        width: likewise.
        times: `(n,) float64`, rising: when each is shown, in seconds from the first.
        seconds: how long the video plays.
    """

    path: Path
    height: int
    width: int
    times: NDArray[np.float64]
    seconds: float

    def __len__(self) -> int:
        return len(self.times)


def video_kind(path: Path) -> str | None:
    """Return the ending that fits the first bytes of a file; None if it is no video.

    Raises:
        UnreadableFile: it cannot be read, or is no regular file of its directory.
    """
    with unreadable(path), open_regular(path) as file:
        begin = file.read(_BEGIN)
    if begin[4:8] == b"ftyp":
        return ".mp4"
    if begin[:4] == b"RIFF" and begin[8:12] == b"AVI ":
        return ".avi"
    return ".mkv" if begin[:4] == b"\x1a\x45\xdf\xa3" else None


def read_stream(path: Path) -> VideoStream:
    """Return what there is to be seen in a file.

    Raises:
        UnreadableFile: it is no video, or has no frame.
        EncoderError: it is damaged.
        Error: ffmpeg cannot be started.
    """
    arguments = [*_reading(path), "-c", "copy", "-f", "framecrc", "pipe:1"]
    output = run_ffmpeg(arguments, what=f"The video {path.name} cannot be read.")
    headers: dict[bytes, tuple[int, int]] = {}
    packets: list[tuple[int, int]] = []
    for line in output.splitlines():
        packet = _PACKET.fullmatch(line)
        header = _HEADER.fullmatch(line)
        if packet is not None:
            time = int(packet["time"])
            known = int(packet["decoded"]) if time == _NO_TIME else time
            packets.append((known, int(packet["duration"])))
        elif header is not None:
            headers[header["key"]] = (int(header["a"]), int(header["b"]))
    if not packets or len(headers) < 2 or not headers[b"tb"][1]:
        raise UnreadableFile(path, "there is no frame in it")
    # Frames are stored in the order in which they are decoded.
    packets.sort()
    unit = float(Fraction(*headers[b"tb"]))
    width, height = headers[b"dimensions"]
    times = np.array([time for time, _ in packets], np.float64)
    times = (times - times[0]) * unit
    seconds = float(times[-1] + packets[-1][1] * unit)
    return VideoStream(regular_path(path), height, width, times, seconds)


def frames_at(
    stream: VideoStream, indices: Sequence[int], *, most_width: int | None = None
) -> Iterator[Frame]:
    """Yield some frames of a video, decoded, as `(height, width, 3) uint8`.

    Args:
        stream: of `read_stream`.
        indices: of the frames, rising.
        most_width: in pixels; wider ones are made smaller.

    Raises:
        EncoderError: it cannot be decoded so far.
        UnreadableFile: it has fewer frames than it claims.
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
                stream.path, f"it has fewer than its {len(stream)} frames"
            )
        yield from np.frombuffer(data, np.uint8).reshape(len(some), -1, width, 3)


def _reading(path: Path) -> list[str]:
    """Return the arguments for reading a file."""
    kind = video_kind(path)
    if kind is None:
        raise UnreadableFile(path, "it is no video of a kind that is read here")
    with unreadable(path):
        source = as_file(regular_path(path))
    return [
        *("-hide_banner", "-loglevel", "error", "-nostdin"),
        *("-threads", "1", "-protocol_whitelist", "file,pipe"),
        *("-max_pixels", str(_MOST_PIXELS), "-noautorotate"),
        *("-f", _KINDS[kind], "-i", source, "-map", "0:v:0"),
    ]

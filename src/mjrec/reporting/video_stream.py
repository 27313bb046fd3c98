# SPDX-License-Identifier: Apache-2.0
"""What there is to be seen in the file of a video, and pictures out of it.

ffmpeg (imageio's) reads a file as nothing but what its first bytes say that it is, and
opens no other file for it.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..formats.ffmpeg import (
    FfmpegProcess,
    as_file,
    every_frame_arguments,
    run_ffmpeg,
)
from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular, regular_path
from ..frames import Frame

_BEGIN: Final = 12
# By ending: what ffmpeg calls them.
_KINDS: Final = {".mp4": "mp4", ".avi": "avi", ".mkv": "matroska"}

_HEADER: Final = re.compile(rb"#(?P<key>tb|dimensions) 0: (?P<a>\d+)[/x](?P<b>\d+)")
# Stream, decoding time, presentation time, duration, size, checksum.
_PACKET: Final = re.compile(rb"0, *-?\d+, *(?P<time>-?\d+), *(?P<duration>\d+), .*")
# A crafted file may claim any size.
_MOST_PIXELS: Final = 16384 * 16384
# ffmpeg reads sums of less than a hundred terms.
_AT_ONCE: Final = 64


@dataclass(frozen=True)
class VideoStream:
    """The pictures of a video, none of them decoded.

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
        UnreadableFile: it is no video, or has no picture.
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
            packets.append((int(packet["time"]), int(packet["duration"])))
        elif header is not None:
            headers[header["key"]] = (int(header["a"]), int(header["b"]))
    if not packets or len(headers) < 2 or not headers[b"tb"][1]:
        raise UnreadableFile(path, "there is no picture in it")
    # Pictures are stored in the order in which they are decoded.
    packets.sort()
    unit = float(Fraction(*headers[b"tb"]))
    width, height = headers[b"dimensions"]
    times = np.array([time for time, _ in packets], np.float64)
    times = (times - times[0]) * unit
    seconds = float(times[-1] + packets[-1][1] * unit)
    return VideoStream(regular_path(path), height, width, times, seconds)


def stream_frames(
    stream: VideoStream, indices: Sequence[int]
) -> Generator[Frame, None, None]:
    """Yield some pictures of a video, decoded, as `(height, width, 3) uint8`.

    Args:
        stream: of `read_stream`.
        indices: of the pictures, rising.

    Raises:
        EncoderError: it cannot be decoded so far.
        UnreadableFile: it has fewer pictures than it claims.
    """
    for begin in range(0, len(indices), _AT_ONCE):
        yield from _decoded(stream, indices[begin : begin + _AT_ONCE])


def _decoded(stream: VideoStream, indices: Sequence[int]) -> Iterator[Frame]:
    wanted = "+".join(rf"eq(n\,{index})" for index in indices)
    arguments = [
        *_reading(stream.path),
        *("-vf", f"select={wanted},format=rgb24", *every_frame_arguments()),
        *("-frames:v", str(len(indices)), "-f", "rawvideo", "pipe:1"),
    ]
    what = f"The video {stream.path.name} cannot be decoded."
    size = stream.height * stream.width * 3
    with FfmpegProcess(arguments, what=what, writes=True) as process:
        for _ in indices:
            data = _read(process, size)
            if len(data) < size:
                process.wait()
                raise UnreadableFile(
                    stream.path, f"it has fewer than its {len(stream)} pictures"
                )
            frame = np.frombuffer(data, np.uint8)
            yield frame.reshape(stream.height, stream.width, 3)


def jpeg_at(stream: VideoStream, seconds: float, *, most_width: int) -> bytes:
    """Return the picture that is shown at a time, as JPEG.

    Args:
        stream: of `read_stream`.
        seconds: from the first picture on.
        most_width: in pixels; a wider one is made smaller.

    Raises:
        EncoderError: it cannot be decoded.
    """
    # What JPEG means by its colours, whatever the video does.
    scale = (
        rf"scale=min({most_width}\,iw):-2:flags=area:out_color_matrix=bt601"
        ":out_range=full,format=yuvj420p"
    )
    return run_ffmpeg(
        [
            *_reading(stream.path, "-ss", f"{seconds:.6f}"),
            *("-frames:v", "1", "-vf", scale, "-c:v", "mjpeg", "-q:v", "3"),
            *("-flags:v", "+bitexact", "-fflags", "+bitexact"),
            *("-f", "image2pipe", "pipe:1"),
        ],
        what=f"The video {stream.path.name} cannot be decoded.",
    )


def _reading(path: Path, *options: str) -> list[str]:
    """Return the arguments for reading a file."""
    kind = video_kind(path)
    if kind is None:
        raise UnreadableFile(path, "it is no video of a kind that is read here")
    with unreadable(path):
        source = as_file(regular_path(path))
    return [
        *("-hide_banner", "-loglevel", "error", "-nostdin"),
        *("-threads", "1", "-protocol_whitelist", "file,pipe"),
        *("-max_pixels", str(_MOST_PIXELS), "-noautorotate", *options),
        *("-f", _KINDS[kind], "-i", source, "-map", "0:v:0"),
    ]


def _read(process: FfmpegProcess, size: int) -> bytes:
    """Return so many bytes; fewer at the end."""
    data = bytearray()
    while len(data) < size:
        block = process.read(size - len(data))
        if not block:
            break
        data += block
    return bytes(data)

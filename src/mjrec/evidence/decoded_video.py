# SPDX-License-Identifier: Apache-2.0
"""Decoding of an archive's video, frame by frame.

ffmpeg reads the file only as an mp4 with H.264, whatever the file declares, and opens
no other file for it. The decoded stream states its own size, so that a video of a
different size is not mistaken for one of the recorded size.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from ..errors import UnreadableFile
from ..formats.ffmpeg import (
    FfmpegProcess,
    as_file,
    every_frame_arguments,
    run_ffmpeg,
)
from ..formats.json_fields import unreadable
from ..formats.regular_files import regular_path
from .frame_similarity import Planes

_BEGINNING: Final = ("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror")
_INPUT: Final = ("-threads", "2", "-protocol_whitelist", "file", "-f", "mp4")
# The colour tags that mjrec writes. The second filter keeps everything but frames;
# decoding parameters are in the file's header, not among the frames.
_TAGS: Final = (
    "h264_metadata=video_full_range_flag=0:colour_primaries=1:"
    "transfer_characteristics=1:matrix_coefficients=1"
)
_BESIDE_FRAMES: Final = "filter_units=remove_types=1|5|9"
_MOST_BESIDE: Final = 1 << 20
# The message in which x264 lists its settings.
_MESSAGE: Final = b"\0\0\0\1\x06\x05"
_BY_X264: Final = bytes.fromhex("dc45e9bde6d948b7962cd820d923eeef")
_READ_SIZE: Final = 1 << 20
_LONGEST_HEADER: Final = 1024
_HEADER: Final = re.compile(rb"YUV4MPEG2 W(\d{1,5}) H(\d{1,5}) [^\n]*")
_FRAME: Final = b"FRAME\n"


def has_usual_colours(path: Path) -> bool:
    """Return whether a video has mjrec's colour tags.

    Raises:
        EncoderError: the video cannot be read.
    """
    hashes = [
        _stream(path, filters, "-f", "hash", "-hash", "sha256")
        for filters in ("h264_mp4toannexb", f"h264_mp4toannexb,{_TAGS}")
    ]
    return hashes[0] == hashes[1]


def has_messages(path: Path) -> bool:
    """Return whether a video's stream contains messages, such as captions.

    x264's own message does not count.

    Raises:
        EncoderError: the video cannot be read.
    """
    beside = _stream(path, _BESIDE_FRAMES, "-f", "data", "-fs", str(_MOST_BESIDE))
    return bool(beside) and not _is_by_x264(beside)


def _is_by_x264(units: bytes) -> bool:
    """Return whether units of a stream are exactly one message of the encoder.

    The message's size is encoded as a sum of bytes, the last of which is not 255.
    """
    sizes = units.removeprefix(_MESSAGE)
    full = len(sizes) - len(sizes.lstrip(b"\xff"))
    size = 255 * full + int.from_bytes(sizes[full : full + 1])
    message = sizes[full + 1 :]
    return (
        units.startswith(_MESSAGE)
        and message.startswith(_BY_X264)
        and message[size:] == b"\x80"
    )


def _stream(path: Path, filters: str, *output: str) -> bytes:
    """Return a video's stream after bitstream filters, without decoding it."""
    arguments = [
        *_BEGINNING,
        *_INPUT,
        *("-i", as_file(path), "-map", "0:v:0", "-c", "copy", "-bsf:v", filters),
        *(*output, "pipe:1"),
    ]
    return run_ffmpeg(arguments, what=f"The video {path.name} cannot be read.")


@contextlib.contextmanager
def decoded_video(path: Path) -> Iterator[tuple[str, Iterator[Planes]]]:
    """Decode a video.

    Args:
        path: the mp4 file.

    Yields:
        ffmpeg's header of the stream (size, rate, pixel aspect ratio, format), and the
        planes of each frame, to the end of the file.

    Raises:
        UnreadableFile: the path is not a regular file, or the video has no frames or an
            odd height or width.
        EncoderError: the video cannot be decoded (to its end).
        Error: ffmpeg cannot be started.
    """
    with unreadable(path):
        source = as_file(regular_path(path))
    arguments = [
        *(*_BEGINNING, *_INPUT, "-c:v", "h264", "-i", source),
        *("-map", "0:v:0", *every_frame_arguments()),
        *("-pix_fmt", "yuv420p", "-f", "yuv4mpegpipe", "pipe:1"),
    ]
    what = f"The video {path.name} cannot be decoded."
    with FfmpegProcess(arguments, what=what, writes=True) as process:
        output = io.BufferedReader(_Output(process), _READ_SIZE)
        line = output.readline(_LONGEST_HEADER).removesuffix(b"\n")
        if not line:
            process.wait()
            raise UnreadableFile(path, "it contains no frames")
        match = _HEADER.fullmatch(line)
        if match is None:
            raise UnreadableFile(path, f"ffmpeg describes it as {line!r:.80}")
        width, height = map(int, match.groups())
        if height % 2 or width % 2:
            raise UnreadableFile(path, f"its frame size is odd: {width}x{height}")
        header = line.decode("ascii", "backslashreplace")
        yield header, _planes(output, height, width, process)


class _Output(io.RawIOBase):
    """The output of an ffmpeg process."""

    def __init__(self, process: FfmpegProcess) -> None:
        self._process = process

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        block = self._process.read(len(buffer))
        buffer[: len(block)] = block
        return len(block)


def _planes(
    output: BinaryIO, height: int, width: int, process: FfmpegProcess
) -> Iterator[Planes]:
    size, half = height * width, (height // 2, width // 2)
    while output.read(len(_FRAME)) == _FRAME:
        data = np.frombuffer(output.read(size * 3 // 2), np.uint8)
        if data.size < size * 3 // 2:
            break
        luma, blue, red = np.split(data, (size, size * 5 // 4))
        yield Planes(luma.reshape(height, width), blue.reshape(half), red.reshape(half))
    process.wait()

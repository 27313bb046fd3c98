# SPDX-License-Identifier: Apache-2.0
"""Decoding of an archive's video, frame by frame.

ffmpeg reads the file only as an mp4 with H.264, whatever the file declares, and opens
no other file for it. The decoded stream states its own size, so that a video of a
different size is not mistaken for one of the recorded size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Self

import numpy as np

from ..errors import UnreadableFile
from ..formats.ffmpeg import (
    FfmpegProcess,
    as_file,
    every_frame_arguments,
    run_ffmpeg,
)
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


class DecodedVideo:
    """A video that is being decoded. Use it in a `with` block.

    Args:
        path: the mp4 file.

    Attributes:
        height: height of the frames in pixels.
        width: width of the frames in pixels.
        header: ffmpeg's header of the stream: size, rate, pixel aspect ratio, format.

    Raises:
        UnreadableFile: the path is not a regular file, or the video has no frames or an
            odd height or width.
        EncoderError: the video cannot be decoded.
        Error: ffmpeg cannot be started.
    """

    def __init__(self, path: Path) -> None:
        try:
            source = regular_path(path)
        except (OSError, ValueError) as error:
            raise UnreadableFile(path, error) from error
        self._rest = b""
        self._process = FfmpegProcess(
            [
                *_BEGINNING,
                *_INPUT,
                *("-c:v", "h264", "-i", as_file(source)),
                *("-map", "0:v:0", *every_frame_arguments()),
                *("-pix_fmt", "yuv420p", "-f", "yuv4mpegpipe", "pipe:1"),
            ],
            what=f"The video {path.name} cannot be decoded.",
            writes=True,
        )
        try:
            self._read_header(path)
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[Planes]:
        """Yield the planes of each frame, to the end of the file.

        Raises:
            EncoderError: the video cannot be decoded to its end.
        """
        size = self.height * self.width
        while self._take(len(_FRAME)) == _FRAME:
            data = np.frombuffer(self._take(size * 3 // 2), np.uint8)
            if data.size < size * 3 // 2:
                break
            half = self.height // 2, self.width // 2
            quarter = size // 4
            yield Planes(
                data[:size].reshape(self.height, self.width),
                data[size : size + quarter].reshape(half),
                data[size + quarter :].reshape(half),
            )
        self._process.wait()

    def close(self) -> None:
        """Stop ffmpeg. Idempotent."""
        self._process.kill()
        self._process.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_header(self, path: Path) -> None:
        while b"\n" not in self._rest and len(self._rest) < _LONGEST_HEADER:
            block = self._process.read(_LONGEST_HEADER)
            if not block:
                self._process.wait()
                raise UnreadableFile(path, "it contains no frames")
            self._rest += block
        line, _, self._rest = self._rest.partition(b"\n")
        match = _HEADER.fullmatch(line)
        if match is None:
            raise UnreadableFile(path, f"ffmpeg describes it as {line!r:.80}")
        width, height = map(int, match.groups())
        if height % 2 or width % 2:
            raise UnreadableFile(path, f"its frame size is odd: {width}x{height}")
        self.height, self.width = height, width
        self.header = line.decode("ascii", "backslashreplace")

    def _take(self, size: int) -> bytes:
        """Read exactly `size` bytes; fewer at the end."""
        parts, missing = [self._rest[:size]], size - len(self._rest[:size])
        self._rest = self._rest[size:]
        while missing:
            block = self._process.read(min(_READ_SIZE, missing))
            if not block:
                break
            parts.append(block)
            missing -= len(block)
        return b"".join(parts)

# SPDX-License-Identifier: Apache-2.0
"""The frames of a shipped video, decoded one after the other.

ffmpeg reads the file as nothing but an mp4 with H.264 in it, whatever it says of
itself, and opens no other file for it. What it gives tells its own size, so that a file
of another size is not taken for one of the recorded size.
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
# The tags of colours that mjrec writes; and all but frames, among which are no
# parameters of decoding: these stand in the file's head, for all players alike.
_TAGS: Final = (
    "h264_metadata=video_full_range_flag=0:colour_primaries=1:"
    "transfer_characteristics=1:matrix_coefficients=1"
)
_BESIDE_FRAMES: Final = "filter_units=remove_types=1|5|9"
_MOST_BESIDE: Final = 1 << 20
# A message by x264, which says how it encodes.
_MESSAGE: Final = b"\0\0\0\1\x06\x05"
_BY_X264: Final = bytes.fromhex("dc45e9bde6d948b7962cd820d923eeef")
_READ_SIZE: Final = 1 << 20
_LONGEST_HEADER: Final = 1024
_HEADER: Final = re.compile(rb"YUV4MPEG2 W(\d{1,5}) H(\d{1,5}) [^\n]*")
_FRAME: Final = b"FRAME\n"


def has_usual_colours(path: Path) -> bool:
    """Return whether the tags of a video let players show its colours as they are.

    Raises:
        EncoderError: it cannot be read.
    """
    hashes = [
        _stream(path, filters, "-f", "hash", "-hash", "sha256")
        for filters in ("h264_mp4toannexb", f"h264_mp4toannexb,{_TAGS}")
    ]
    return hashes[0] == hashes[1]


def has_messages(path: Path) -> bool:
    """Return whether anything but frames is in a video's stream, such as captions.

    Raises:
        EncoderError: it cannot be read.
    """
    beside = _stream(path, _BESIDE_FRAMES, "-f", "data", "-fs", str(_MOST_BESIDE))
    return bool(beside) and not _is_by_x264(beside)


def _is_by_x264(units: bytes) -> bool:
    """Return whether units of a stream are one message of the encoder's, and no more.

    Its size is a sum of bytes, of which the last is not 255.
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
    """Return what filters of its bits make of a video's stream; nothing is decoded."""
    arguments = [
        *_BEGINNING,
        *_INPUT,
        *("-i", as_file(path), "-map", "0:v:0", "-c", "copy", "-bsf:v", filters),
        *(*output, "pipe:1"),
    ]
    return run_ffmpeg(arguments, what=f"The video {path.name} cannot be read.")


class DecodedVideo:
    """A video that is being decoded; used in a `with` block.

    Args:
        path: of the mp4.

    Attributes:
        height: of its frames, in pixels.
        width: likewise.
        header: what ffmpeg says of the stream: size, rate, shape of a pixel, format.

    Raises:
        UnreadableFile: it is no regular file.
        EncoderError: it cannot be decoded.
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
            EncoderError: it cannot be decoded to its end.
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
        """End ffmpeg, whatever it is at. Idempotent."""
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
                raise UnreadableFile(path, "there is no frame in it")
            self._rest += block
        line, _, self._rest = self._rest.partition(b"\n")
        match = _HEADER.fullmatch(line)
        if match is None:
            raise UnreadableFile(path, f"ffmpeg says {line!r:.80} of it")
        width, height = map(int, match.groups())
        if height % 2 or width % 2:
            raise UnreadableFile(path, f"its frames are {width}x{height}")
        self.height, self.width = height, width
        self.header = line.decode("ascii", "backslashreplace")

    def _take(self, size: int) -> bytes:
        """Return this many bytes; fewer at the end."""
        parts, missing = [self._rest[:size]], size - len(self._rest[:size])
        self._rest = self._rest[size:]
        while missing:
            block = self._process.read(min(_READ_SIZE, missing))
            if not block:
                break
            parts.append(block)
            missing -= len(block)
        return b"".join(parts)

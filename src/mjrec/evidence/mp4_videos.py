# SPDX-License-Identifier: Apache-2.0
"""Reading an archive's mp4 file: its boxes, its stream, and its decoded frames.

Players obey the boxes, which may declare a second track on top, an edit list that skips
the end, or non-square pixels. So both boxes and frames are compared.

ffmpeg reads the file only as an mp4 with H.264, whatever the file declares, and opens
no other files. The decoded stream states its own size, so that a video of a different
size is not mistaken for one of the recorded size.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Final

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
from .frame_similarity import Planes

# Boxes that contain boxes, and the number of their own bytes that precede these.
_CONTAINERS: Final = {
    **dict.fromkeys(("moov", "trak", "edts", "mdia", "minf", "dinf", "stbl"), 0),
    "stsd": 8,
    "avc1": 78,
}
_MEDIA: Final = "mdat"
_LARGEST_BOX: Final = 1 << 27
_MOST_BOXES: Final = 1000
_BEGINNING: Final = ("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror")
_INPUT: Final = ("-threads", "2", "-protocol_whitelist", "file", "-f", "mp4")
# The color tags that mjrec writes. The second filter keeps everything but frames;
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
# The parts of that message that may differ: versions, a year, and values of settings.
_VALUES: Final = re.compile(
    rb"(?<=core )\d{1,4}( r\d{1,5} [0-9a-f]{7})?|(?<=2003-)\d{4}"
    rb"|(?<==)([\d.:,x-]{1,16}|[a-z]{3,4})(?=[ \0])"
)
# What may follow the parameters of a stream: that it is yuv420p.
_FORMATS: Final = (b"", b"\xfd\xf8\xf8\0")
_READ_SIZE: Final = 1 << 20
_LONGEST_HEADER: Final = 1024
_HEADER: Final = re.compile(rb"YUV4MPEG2 W(\d{1,5}) H(\d{1,5}) [^\n]*")
_FRAME: Final = b"FRAME\n"


@dataclass(frozen=True)
class Box:
    """A box in a file.

    Attributes:
        path: its name, preceded by those of the enclosing boxes: "moov/trak/mdia".
        content: its own bytes; empty for `mdat`.
        size: size of its content in bytes, including boxes inside it.
    """

    path: str
    content: bytes
    size: int

    @property
    def name(self) -> str:
        """The box's own name."""
        return self.path.rpartition("/")[2]


def read_boxes(path: Path) -> list[Box]:
    """Return the boxes of an mp4 file in order, each before the boxes inside it.

    Raises:
        UnreadableFile: the file is damaged or has far too many boxes.
    """
    with unreadable(path), open_regular(path) as file:
        end = file.seek(0, 2)
        found: list[Box] = []
        for box in _boxes(file, 0, end, ""):
            found.append(box)
            if len(found) > _MOST_BOXES:
                raise ValueError("it has far more boxes than any video")
        return found


def _boxes(file: BinaryIO, start: int, end: int, outer: str) -> Iterator[Box]:
    while start < end:
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            raise ValueError("a box is cut off")
        size, head_size = int.from_bytes(head[:4]), 8
        if size == 1:
            size, head_size = int.from_bytes(head[8:]), 16
        name = head[4:8].decode("ascii", "backslashreplace").replace("/", "\\")
        if not head_size <= size <= end - start:
            raise ValueError(f"the box {name!r} has the wrong size")
        path = f"{outer}/{name}" if outer else name
        own = _CONTAINERS.get(name, size - head_size)
        if name == _MEDIA:
            own = 0
        if own > min(size - head_size, _LARGEST_BOX):
            raise ValueError(f"the box {name!r} has the wrong size")
        file.seek(start + head_size)
        yield Box(path, file.read(own), size - head_size)
        if name in _CONTAINERS:
            yield from _boxes(file, start + head_size + own, start + size, path)
        start += size


def shown_times(boxes: Sequence[Box]) -> tuple[int, Fraction] | str:
    """Return the number of frames shown and the duration of each in seconds.

    If the frames are not shown evenly, return the reason instead.

    Raises:
        ValueError: the tables contradict each other, or do not have the form that mjrec
            writes.
    """
    try:
        duration, offsets = _table(boxes, "stts"), _table(boxes, "ctts")
        [scale] = struct.unpack(">I", _one(boxes, "mdhd").content[12:16])
        sizes = np.frombuffer(_one(boxes, "stsz").content[12:], ">u4")
        # Only other programs write 64-bit times or several edits.
        edits, _, begin, rate = struct.unpack(">4xIIiI", _one(boxes, "elst").content)
    except (KeyError, struct.error) as error:
        raise ValueError(
            f"its tables do not have the form that mjrec writes: {error}"
        ) from error
    if len(set(duration.tolist())) != 1 or edits != 1 or rate != 1 << 16:
        return "its frames are not all shown for the same duration"
    each, count = int(duration[0]), len(duration)
    shown = np.arange(count) * each - begin
    if len(offsets):
        if len(offsets) != count:
            raise ValueError("its tables have different numbers of frames")
        shown = shown + offsets
    if not each or not np.array_equal(np.sort(shown), np.arange(count) * each):
        return "its frames are not evenly spaced from the start"
    if int(sizes.sum()) != sum(box.size for box in boxes if box.name == _MEDIA):
        return "it contains more than its frames"
    return count, Fraction(each, scale)


def _one(boxes: Sequence[Box], name: str) -> Box:
    found = [box for box in boxes if box.name == name]
    if len(found) != 1:
        raise KeyError(f"it has {len(found)} boxes {name!r}")
    return found[0]


def _table(boxes: Sequence[Box], name: str) -> NDArray[np.int64]:
    """Return a run-length table as one number per frame; empty if it is missing."""
    if not any(box.name == name for box in boxes):
        return np.empty(0, np.int64)
    runs = np.frombuffer(_one(boxes, name).content[8:], ">u4").reshape(-1, 2)
    if int(runs[:, 0].sum()) > _LARGEST_BOX:
        raise ValueError("it claims to have far too many frames")
    return np.repeat(runs[:, 1].astype(">u4").view(">i4").astype(np.int64), runs[:, 0])


def odd_contents(path: Path, made: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the unusual contents of a video's stream: color tags and captions.

    x264's own message does not count if it names the same settings as in `made`.

    Yields:
        The place, its content, and the expected content.

    Raises:
        EncoderError, UnreadableFile: the video cannot be read.
    """
    with unreadable(path):
        is_plain = _is_plain(_one(read_boxes(path), "avcC").content)
    if not is_plain:
        yield "avcC", "more than the stream's parameters", "these"
    tagged, usual = (
        _stream(path, filters, "-f", "hash", "-hash", "sha256")
        for filters in ("h264_mp4toannexb", f"h264_mp4toannexb,{_TAGS}")
    )
    if tagged != usual:
        yield "color tags", "other tags", "BT.709"
    beside, own = (
        _stream(each, _BESIDE_FRAMES, "-f", "data", "-fs", str(_MOST_BESIDE))
        for each in (path, made)
    )
    texts = [_VALUES.sub(b"", each.partition(_BY_X264)[2]) for each in (beside, own)]
    if beside and not (_is_by_x264(beside) and texts[0] == texts[1]):
        yield "the stream", "frames and messages", "frames"


def _is_plain(parameters: bytes) -> bool:
    """Return whether an `avcC` box has one parameter set of each kind, and no more."""
    size = int.from_bytes(parameters[6:8])
    rest = parameters[8 + size :]
    end = 3 + int.from_bytes(rest[1:3])
    return parameters[5:6] + rest[:1] == b"\xe1\1" and rest[end:] in _FORMATS


def _is_by_x264(units: bytes) -> bool:
    """Return whether units of a stream are exactly one message of the encoder.

    A message's size is the sum of any bytes of value 255 and of the first other byte.
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
        EncoderError: the video cannot be decoded completely.
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

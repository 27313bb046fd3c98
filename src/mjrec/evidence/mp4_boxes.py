# SPDX-License-Identifier: Apache-2.0
"""The boxes of an mp4 file: tracks, times, the shape of frames, and other content.

Players follow the boxes, whatever the frames are: a second track on top, an edit list
that skips the end, non-square pixels. So the boxes are compared as well as the frames.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular

# Boxes that contain boxes, and the number of bytes of their own that come first.
_CONTAINERS: Final = {
    **dict.fromkeys(("moov", "trak", "edts", "mdia", "minf", "dinf", "stbl"), 0),
    "stsd": 8,
    "avc1": 78,
}
_MEDIA: Final = "mdat"
_LARGEST_BOX: Final = 1 << 27
_MOST_BOXES: Final = 1000


@dataclass(frozen=True)
class Box:
    """A box in a file.

    Attributes:
        path: its name after those of the boxes around it: "moov/trak/mdia".
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
    """Return the boxes of an mp4 file in order; each comes before those inside it.

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
            raise ValueError(f"the box {name!r} has a wrong size")
        path = f"{outer}/{name}" if outer else name
        own = _CONTAINERS.get(name, size - head_size)
        if name == _MEDIA:
            own = 0
        if own > min(size - head_size, _LARGEST_BOX):
            raise ValueError(f"the box {name!r} has a wrong size")
        file.seek(start + head_size)
        yield Box(path, file.read(own), size - head_size)
        if name in _CONTAINERS:
            yield from _boxes(file, start + head_size + own, start + size, path)
        start += size


def shown_times(boxes: Sequence[Box]) -> tuple[int, Fraction] | str:
    """Return the number of frames shown and the duration of each in seconds.

    If the frames are not shown evenly, return the reason instead.

    Raises:
        ValueError: the tables contradict each other, or are not as mjrec writes them.
    """
    try:
        duration, offsets = _table(boxes, "stts"), _table(boxes, "ctts")
        [scale] = struct.unpack(">I", _one(boxes, "mdhd").content[12:16])
        sizes = np.frombuffer(_one(boxes, "stsz").content[12:], ">u4")
        # Only other programs write 64-bit times or several edits.
        edits, _, begin, rate = struct.unpack(">4xIIiI", _one(boxes, "elst").content)
    except (KeyError, struct.error) as error:
        raise ValueError(f"its tables are not as mjrec writes them: {error}") from error
    if len(set(duration.tolist())) != 1 or edits != 1 or rate != 1 << 16:
        return "its frames are not all shown for the same time"
    each, count = int(duration[0]), len(duration)
    shown = np.arange(count) * each - begin
    if len(offsets):
        if len(offsets) != count:
            raise ValueError("its tables have different numbers of frames")
        shown = shown + offsets
    if not each or not np.array_equal(np.sort(shown), np.arange(count) * each):
        return "its frames are not evenly spaced from the beginning"
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

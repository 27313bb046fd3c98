# SPDX-License-Identifier: Apache-2.0
"""The `.framehash` file: the sha256 of each frame as it was rendered.

The text is what ffmpeg's `framehash` muxer writes, byte for byte, for the same frames
as raw video (`-fflags +bitexact -f rawvideo -pix_fmt rgb24 ... -f framehash`), so that
its users' tools read it::

    #format: frame checksums
    #version: 2
    #hash: SHA256
    #tb 0: 1/40
    #media_type 0: video
    #codec_id 0: rawvideo
    #dimensions 0: 480x480
    #sar 0: 0/1
    #stream#, dts,        pts, duration,     size, hash
    0,          0,          0,        1,   691200, 5b1f...

The time base (`tb`) is the duration of a frame in seconds; dimensions are WIDTHxHEIGHT;
`size` is in bytes. A frame's bytes are its rows from top to bottom, each pixel red,
green, blue.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import TextIO

import numpy as np

from ..atomic_files import replacing
from ..errors import DirectoryNotWritable, FileNotWritten
from ..frames import Frame

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def frame_hash_header(*, height: int, width: int, fps: Fraction) -> str:
    """Return the lines before the first frame."""
    return (
        "#format: frame checksums\n"
        "#version: 2\n"
        "#hash: SHA256\n"
        f"#tb 0: {fps.denominator}/{fps.numerator}\n"
        "#media_type 0: video\n"
        "#codec_id 0: rawvideo\n"
        f"#dimensions 0: {width}x{height}\n"
        "#sar 0: 0/1\n"
        "#stream#, dts,        pts, duration,     size, hash\n"
    )


def frame_hash_line(number: int, frame: Frame) -> str:
    """Return the line of the frame with this number, counted from 0."""
    digest = hashlib.sha256(np.ascontiguousarray(frame).data).hexdigest()
    return f"0, {number:10d}, {number:10d}, {1:8d}, {frame.nbytes:8d}, {digest}\n"


class FrameHashFile:
    """A `.framehash` file in the making, under a temporary name.

    A line is with the operating system before the next one: what of it a killed process
    leaves is true of the frames that its encoder had been given.

    Args:
        path: the temporary name.
        final: the name that it will have, for errors.
        size: `(height, width)` of the frames.
        fps: frames per second.

    Every method raises `FileNotWritten` when the disk is full, or a quota or a limit on
    files' sizes is reached, and `DirectoryNotWritable` when the file cannot be written
    for another reason.
    """

    def __init__(
        self, path: Path, *, final: Path, size: tuple[int, int], fps: Fraction
    ) -> None:
        self._path = path
        self._final = final
        self._frame_count = 0
        height, width = size
        with self._naming_the_file():
            self._file: TextIO = path.open("w", encoding="ascii", buffering=1)
            try:
                self._file.write(frame_hash_header(height=height, width=width, fps=fps))
            except BaseException:
                self.abort()
                raise

    def add(self, frame: Frame) -> None:
        """Write the next frame's line."""
        with self._naming_the_file():
            self._file.write(frame_hash_line(self._frame_count, frame))
        self._frame_count += 1

    def close(self) -> None:
        """Close the file, which keeps its temporary name. May be called again."""
        with self._naming_the_file():
            self._file.close()

    def abort(self) -> None:
        """Leave nothing."""
        # What cannot be written any more need not be.
        with contextlib.suppress(OSError):
            self._file.close()
        self._path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _naming_the_file(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in _NO_ROOM:
                raise FileNotWritten(self._final, error.strerror) from error
            raise DirectoryNotWritable(self._final.parent, error) from error


def cut_frame_hashes(path: Path, count: int) -> None:
    """Leave only the first `count` frames' hashes in a file, whole or not at all.

    Raises:
        OSError: it cannot be read or written.
        ValueError: it holds fewer, or is no such file.
    """
    header = frame_hash_header(height=1, width=1, fps=Fraction(1)).count("\n")
    lines = path.read_text(encoding="ascii").splitlines(keepends=True)
    # The last one may be torn.
    kept = [line for line in lines[: header + count] if line.endswith("\n")]
    if len(kept) < header + count:
        raise ValueError(f"it has hashes of fewer than {count} frames")
    if len(kept) < len(lines):
        with replacing(path) as temporary:
            temporary.write_text("".join(kept), encoding="ascii")


def frame_hash_path(video: Path) -> Path:
    """Return the name of the `.framehash` file of a video."""
    return video.with_suffix(".framehash")

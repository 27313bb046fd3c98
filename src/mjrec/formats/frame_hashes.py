# SPDX-License-Identifier: Apache-2.0
"""The `.framehash` file: the SHA-256 of each rendered frame.

The content is byte for byte identical to the output of ffmpeg's `framehash` muxer for
the same frames as raw video (`-fflags +bitexact -f rawvideo -pix_fmt rgb24 ... -f
framehash`). Tools that read ffmpeg's files can read this file too::

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

The time base (`tb`) is the duration of a frame in seconds, dimensions are WIDTHxHEIGHT,
and `size` is in bytes. A frame's bytes are its rows from top to bottom, with red, green
and blue for each pixel.
"""

from __future__ import annotations

import hashlib
from fractions import Fraction
from pathlib import Path

import numpy as np

from ..atomic_files import replacing
from ..frames import Frame


def frame_hash_header(*, height: int, width: int, fps: Fraction) -> str:
    """Return the lines before the line for the first frame."""
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
    """Return the line for the frame with this number, counted from 0."""
    digest = hashlib.sha256(np.ascontiguousarray(frame).data).hexdigest()
    return f"0, {number:10d}, {number:10d}, {1:8d}, {frame.nbytes:8d}, {digest}\n"


def cut_frame_hashes(path: Path, count: int) -> None:
    """Atomically truncate a file to the hashes of its first `count` frames.

    Raises:
        OSError: the file cannot be read or written.
        ValueError: the file contains fewer hashes, or is not a `.framehash` file.
    """
    header = frame_hash_header(height=1, width=1, fps=Fraction(1)).count("\n")
    lines = path.read_text(encoding="ascii").splitlines(keepends=True)
    # The last line may be incomplete.
    kept = [line for line in lines[: header + count] if line.endswith("\n")]
    if len(kept) < header + count:
        raise ValueError(f"it has hashes for fewer than {count} frames")
    if len(kept) < len(lines):
        with replacing(path) as temporary:
            temporary.write_text("".join(kept), encoding="ascii")


def frame_hash_path(video: Path) -> Path:
    """Return the path of the `.framehash` file of a video."""
    return video.with_suffix(".framehash")

# SPDX-License-Identifier: Apache-2.0
"""The `.framehash` file against ffmpeg's own."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit

from mjrec.errors import DirectoryNotWritable, FileNotWritten
from mjrec.formats.ffmpeg import run_ffmpeg
from mjrec.formats.frame_hashes import (
    FrameHashFile,
    frame_hash_line,
    frame_hash_path,
)
from mjrec.frames import Frame


def noise(count: int, height: int, width: int) -> Frame:
    shape = (count, height, width, 3)
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize(
    ("height", "width", "fps"),
    [
        (5, 8, Fraction(40)),
        (7, 9, Fraction(30000, 1001)),
        (600, 801, Fraction(1, 1000)),
        (2, 2, Fraction(1000000, 33333)),
    ],
)
def test_the_text_is_ffmpegs_own(
    tmp_path: Path, height: int, width: int, fps: Fraction
) -> None:
    """Odd and even sizes, whole and broken rates: byte for byte ffmpeg's output."""
    frames = noise(12, height, width)
    path = tmp_path / "a.framehash"
    file = FrameHashFile(path, final=path, size=(height, width), fps=fps)
    for frame in frames:
        file.add(frame)
    file.close()
    arguments = (
        f"-v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i - "
        "-fflags +bitexact -f framehash -"
    )
    theirs = run_ffmpeg(arguments.split(), standard_input=frames.tobytes())
    assert path.read_bytes() == theirs


def test_a_view_is_hashed_as_it_looks() -> None:
    """A flipped view has the hash of the flipped picture, not of its memory."""
    (frame,) = noise(1, 4, 6)
    assert frame_hash_line(0, frame[::-1]) == frame_hash_line(0, frame[::-1].copy())
    assert frame_hash_line(0, frame[::-1]) != frame_hash_line(0, frame)


def test_it_is_called_as_its_video() -> None:
    """But for the ending."""
    assert frame_hash_path(Path("run.1.mp4")) == Path("run.1.framehash")


def test_a_disk_that_takes_nothing_is_one_error() -> None:
    """What the system says comes with the directory's name."""
    with pytest.raises(DirectoryNotWritable, match="/proc"):
        FrameHashFile(
            Path("/proc/.part"),
            final=Path("/proc/a.framehash"),
            size=(4, 6),
            fps=Fraction(1),
        )


def test_a_full_disk_is_named_with_the_file(tmp_path: Path) -> None:
    """And nothing is left of it."""
    part, final = tmp_path / "part", tmp_path / "run.framehash"
    file = FrameHashFile(part, final=final, size=(4, 6), fps=Fraction(1))
    with file_size_limit(100), pytest.raises(FileNotWritten, match=str(final)):
        file.add(np.zeros((4, 6, 3), np.uint8))
    file.abort()
    with file_size_limit(100), pytest.raises(FileNotWritten, match=str(final)):
        FrameHashFile(part, final=final, size=(4, 6), fps=Fraction(1))
    assert list(tmp_path.iterdir()) == []

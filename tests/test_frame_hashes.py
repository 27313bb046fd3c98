# SPDX-License-Identifier: Apache-2.0
"""The `.framehash` file against ffmpeg's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjrec.formats.frame_hashes import frame_hash_line, frame_hash_path
from mjrec.frames import Frame


def noise(count: int, height: int, width: int) -> Frame:
    shape = (count, height, width, 3)
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def test_a_view_is_hashed_as_it_looks() -> None:
    """A flipped view has the hash of the flipped picture, not of its memory."""
    (frame,) = noise(1, 4, 6)
    assert frame_hash_line(0, frame[::-1]) == frame_hash_line(0, frame[::-1].copy())
    assert frame_hash_line(0, frame[::-1]) != frame_hash_line(0, frame)


def test_it_is_called_as_its_video() -> None:
    """But for the ending."""
    assert frame_hash_path(Path("run.1.mp4")) == Path("run.1.framehash")

# SPDX-License-Identifier: Apache-2.0
"""Videos that show nothing: black, of one colour, or without any movement.

A lamp that is missing, a camera inside a wall, an OpenGL context of another thread: all
of them give a video that is whole, counted, and of no use.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from .errors import BlankVideo
from .frames import Frame

logger = logging.getLogger(__name__)

# Of 255, the brightest that nobody can tell from black.
_BLACK = 4
# Every so many-th pixel of every so many-th row is looked at first.
_STEP = 16


class BlankFrames:
    """Is told the frames of a video, and knows at the end whether they show anything.

    As soon as one frame has two colours and one differs from the first, nothing more is
    looked at. Only frames that could be blank are looked at as a whole.
    """

    def __init__(self) -> None:
        self._count = 0
        self._all_black = True
        self._all_plain = True
        # None: two of them differ, or there is none yet.
        self._first: Frame | None = None
        self._all_equal = True

    def add(self, frame: Frame) -> None:
        """Look at the next frame, `(height, width, 3) uint8`; it is not kept."""
        self._count += 1
        if not (self._all_black or self._all_plain or self._all_equal):
            return
        sample = frame[::_STEP, ::_STEP]
        if self._all_black:
            self._all_black = _is_black(sample) and _is_black(frame)
        if self._all_plain:
            self._all_plain = _is_plain(sample) and _is_plain(frame)
        if self._all_equal:
            self._compare(frame, sample)

    def facts(self) -> dict[str, bool]:
        """Return what a video's metadata says about it; nothing where all is well.

        `suspect_black`: all frames are black. `suspect_constant`: all frames are of one
        colour each, or there are several and all are the same. Black ones of exactly
        one colour are both.
        """
        if not self._count:
            return {}
        constant = self._all_plain or (self._all_equal and self._count > 1)
        facts = {"suspect_black": self._all_black, "suspect_constant": constant}
        return {name: True for name, is_so in facts.items() if is_so}

    def suspicion(self) -> str | None:
        """Return what is wrong with the video, for a message; None where nothing is."""
        if not self.facts():
            return None
        frames = f"all {self._count} frames are" if self._count > 1 else "its frame is"
        if self._all_black:
            return f"{frames} black"
        if self._all_plain:
            return f"{frames} of a single colour"
        return f"{frames} the same picture"

    def judge(self, video: Path, *, strict: bool) -> None:
        """Warn of a finished video that shows nothing, or raise.

        Raises:
            BlankVideo: `strict`, and it shows nothing.
        """
        suspicion = self.suspicion()
        if suspicion is None:
            return
        if strict:
            raise BlankVideo(video, frame_count=self._count, suspicion=suspicion)
        logger.warning("%s may show nothing: %s.", video.name, suspicion)

    def _compare(self, frame: Frame, sample: Frame) -> None:
        if self._count == 1:
            self._first = frame.copy()
            return
        first = self._first
        assert first is not None
        same = np.array_equal(first[::_STEP, ::_STEP], sample)
        if not (same and np.array_equal(first, frame)):
            self._all_equal, self._first = False, None


def _is_black(frame: Frame) -> bool:
    return int(frame.max()) <= _BLACK


def _is_plain(frame: Frame) -> bool:
    # The first row with its first pixel, all rows with the first: whole rows compare
    # many times faster than pixels.
    row = frame[:1]
    return bool((row == row[:, :1]).all()) and bool((frame == row).all())

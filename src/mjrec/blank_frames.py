# SPDX-License-Identifier: Apache-2.0
"""Detection of videos that show nothing: all black, a single color, or no movement.

If a light is missing, the camera is inside a wall, or the OpenGL context belongs to
another thread, a video can have all of its frames and still be useless.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .errors import BlankVideo
from .frames import Frame

logger = logging.getLogger(__name__)

# The brightest value (0 to 255) that looks black.
_BLACK = 4
# Every n-th pixel of every n-th row is checked first.
_STEP = 16


class BlankFrames:
    """A check of whether a video's frames show anything.

    Checking stops as soon as the video is known to have a frame that is not black, a
    frame with two colors, and a frame that differs from the first. Only frames that
    could be blank are checked completely.
    """

    def __init__(self) -> None:
        self._count = 0
        # The kinds of blankness that all frames so far share.
        self._suspects = set(_LOOKS)
        self._first: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Check the next frame, `(height, width, 3) uint8`, without keeping it."""
        self._count += 1
        if self._first is None and "equal" in self._suspects:
            self._first = frame.copy()
        for name in list(self._suspects):
            looks, first = _LOOKS[name], frame if self._first is None else self._first
            sample = (frame[::_STEP, ::_STEP], first[::_STEP, ::_STEP])
            if not (looks(*sample) and looks(frame, first)):
                self._suspects.discard(name)
        if "equal" not in self._suspects:
            self._first = None

    def facts(self) -> dict[str, bool]:
        """Return facts for the video's metadata, or an empty dict if nothing is wrong.

        `suspect_black`: all frames are black. `suspect_constant`: each frame has a
        single color, or there are several frames and all are equal. Uniformly black
        frames set both.
        """
        if not self._count:
            return {}
        suspects = self._suspects
        constant = "plain" in suspects or ("equal" in suspects and self._count > 1)
        facts = {"suspect_black": "black" in suspects, "suspect_constant": constant}
        return {name: True for name, is_so in facts.items() if is_so}

    def suspicion(self) -> str | None:
        """Return a phrase that describes the problem, or None if nothing is wrong."""
        if not self.facts():
            return None
        frames = f"all {self._count} frames are" if self._count > 1 else "its frame is"
        if "black" in self._suspects:
            return f"{frames} black"
        if "plain" in self._suspects:
            return f"{frames} a single color"
        return f"{frames} identical"

    def judge(self, video: Path, *, strict: bool) -> None:
        """Warn about a finished video that shows nothing, or raise an error.

        Raises:
            BlankVideo: `strict` is True and the video shows nothing.
        """
        suspicion = self.suspicion()
        if suspicion is None:
            return
        if strict:
            raise BlankVideo(video, frame_count=self._count, suspicion=suspicion)
        logger.warning("%s may show nothing: %s.", video.name, suspicion)


def _is_plain(frame: Frame, first: Frame) -> bool:
    # Compare the first row with its first pixel, then all rows with the first row:
    # comparing whole rows is many times faster than comparing pixels.
    row = frame[:1]
    return bool((row == row[:, :1]).all()) and bool((frame == row).all())


# Tests for the ways in which a frame (or a sample of it) may look blank. The second
# argument is the video's first frame.
_LOOKS: dict[str, Callable[[Frame, Frame], bool]] = {
    "black": lambda frame, first: int(frame.max()) <= _BLACK,
    "plain": _is_plain,
    "equal": np.array_equal,
}

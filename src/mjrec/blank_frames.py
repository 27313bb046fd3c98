# SPDX-License-Identifier: Apache-2.0
"""Videos that show nothing: black, of one colour, or without any movement.

A lamp that is missing, a camera inside a wall, an OpenGL context of another thread: all
of them give a video that is whole, counted, and of no use.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .errors import BlankVideo
from .frames import Frame

logger = logging.getLogger(__name__)

# Of 255, the brightest that looks black.
_BLACK = 4
# Every n-th pixel of every n-th row is looked at first.
_STEP = 16


class BlankFrames:
    """Takes the frames of a video and says at the end whether they show anything.

    As soon as one frame has two colours and one differs from the first, nothing more is
    looked at. Only frames that could be blank are looked at as a whole.
    """

    def __init__(self) -> None:
        self._count = 0
        # What all frames so far are.
        self._suspects = set(_LOOKS)
        self._first: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Look at the next frame, `(height, width, 3) uint8`; it is not kept."""
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
        """Return what a video's metadata says about it; nothing where all is well.

        `suspect_black`: all frames are black. `suspect_constant`: all frames are of one
        colour each, or there are several and all are the same. Black ones of exactly
        one colour are both.
        """
        if not self._count:
            return {}
        suspects = self._suspects
        constant = "plain" in suspects or ("equal" in suspects and self._count > 1)
        facts = {"suspect_black": "black" in suspects, "suspect_constant": constant}
        return {name: True for name, is_so in facts.items() if is_so}

    def suspicion(self) -> str | None:
        """Return what is wrong with the video, for a message; None where nothing is."""
        if not self.facts():
            return None
        frames = f"all {self._count} frames are" if self._count > 1 else "its frame is"
        if "black" in self._suspects:
            return f"{frames} black"
        if "plain" in self._suspects:
            return f"{frames} of a single colour"
        return f"{frames} the same frame"

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


def _is_plain(frame: Frame, first: Frame) -> bool:
    # The first row with its first pixel, all rows with the first: whole rows compare
    # many times faster than pixels.
    row = frame[:1]
    return bool((row == row[:, :1]).all()) and bool((frame == row).all())


# What a frame, or a sample of it, may be; beside it the video's first.
_LOOKS: dict[str, Callable[[Frame, Frame], bool]] = {
    "black": lambda frame, first: int(frame.max()) <= _BLACK,
    "plain": _is_plain,
    "equal": np.array_equal,
}

# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from mjrec.blank_frames import BlankFrames


def frame(value=0, *, pixel=None):
    """Return a gray frame in which one pixel may differ."""
    frame = np.full((40, 56, 3), value, np.uint8)
    # A check on a coarse grid of pixels would miss this pixel.
    frame[17, 21] = value if pixel is None else pixel
    return frame


BLACK = {"suspect_black": True, "suspect_constant": True}
CONSTANT = {"suspect_constant": True}


@pytest.mark.parametrize(
    ("frames", "facts"),
    [
        ([], {}),
        ([frame(), frame()], BLACK),
        ([frame(pixel=3), frame(4)], {"suspect_black": True}),
        ([frame(90), frame(30)], CONSTANT),
        ([frame(90), frame(90, pixel=91)], {}),
        ([frame(90, pixel=0)], {}),
        ([frame(90, pixel=0)] * 3, CONSTANT),
        ([frame(90, pixel=0)] * 2 + [frame(90, pixel=1)], {}),
        ([frame()] * 9 + [frame(pixel=255)], {}),
    ],
)
def test_black_constant_or_still_videos_are_suspect(frames, facts):
    """A video in which a single pixel differs is not suspect."""
    blank = BlankFrames()
    for each in frames:
        blank.add(each)
    assert blank.facts() == facts

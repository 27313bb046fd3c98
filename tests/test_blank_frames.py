# SPDX-License-Identifier: Apache-2.0
"""Videos that show nothing say so."""

import numpy as np
import pytest

from mjrec.blank_frames import BlankFrames


def frame(value=0, *, pixel=None):
    """Return a plain frame, with one pixel of another brightness if given."""
    frame = np.full((40, 56, 3), value, np.uint8)
    # Not one that a coarse look would see.
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
def test_what_is_suspect(frames, facts):
    """Black, of one colour each, or without movement; one pixel is enough."""
    blank = BlankFrames()
    for each in frames:
        blank.add(each)
    assert blank.facts() == facts

# SPDX-License-Identifier: Apache-2.0
"""Videos that show nothing say so."""

import numpy as np
import pytest

from mjrec.blank_frames import BlankFrames

SIZE = (40, 56)


def picture(value=0, *, pixel=None):
    """Return a plain picture, with one pixel of another brightness if given."""
    frame = np.full((*SIZE, 3), value, np.uint8)
    if pixel is not None:
        # None that a coarse look would see.
        frame[17, 21] = pixel
    return frame


def facts_of(*frames):
    blank = BlankFrames()
    for frame in frames:
        blank.add(frame)
    return blank.facts()


BLACK = {"suspect_black": True, "suspect_constant": True}
CONSTANT = {"suspect_constant": True}


@pytest.mark.parametrize(
    ("frames", "facts"),
    [
        ([], {}),
        ([picture()], BLACK),
        ([picture(), picture()], BLACK),
        ([picture(pixel=3), picture(4)], {"suspect_black": True}),
        ([picture(90)], CONSTANT),
        ([picture(90), picture(30)], CONSTANT),
        ([picture(90), picture(90, pixel=91)], {}),
        ([picture(90, pixel=0)], {}),
        ([picture(90, pixel=0)] * 3, CONSTANT),
        ([picture(90, pixel=0)] * 2 + [picture(90, pixel=1)], {}),
        ([picture()] * 9 + [picture(pixel=255)], {}),
    ],
)
def test_what_is_suspect(frames, facts):
    """Black, of one colour each, or without movement; one pixel is enough."""
    assert facts_of(*frames) == facts

# SPDX-License-Identifier: Apache-2.0
"""A picture of how a shipped frame differs from what is drawn: three side by side."""

from __future__ import annotations

from typing import Final

import numpy as np

from ...frames import Frame
from .picture_similarity import Planes, frame_of

AMPLIFIED: Final = 8
_GAP: Final = 4
_MIDDLE: Final = 128


def difference_picture(drawn: Planes, shipped: Planes) -> Frame:
    """Return the drawn picture, the shipped one, and their difference, amplified.

    Where nothing differs, the third is grey; where the shipped one is brighter, so is
    the third, 8 times as much. Both have their colours at half the size, as videos do:
    else every coloured edge would be in the difference.
    """
    one, other = frame_of(drawn), frame_of(shipped)
    height = len(one)
    difference = AMPLIFIED * (other.astype(np.int32) - one) + _MIDDLE
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    shown = np.clip(difference, 0, 255).astype(np.uint8)
    return np.concatenate([one, gap, other, gap, shown], axis=1)

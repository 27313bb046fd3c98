# SPDX-License-Identifier: Apache-2.0
"""Several pictures side by side, in one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .errors import InvalidArgument
from .frames import Frame


def grid_shape(count: int) -> tuple[int, int]:
    """Return the rows and columns of the grid of so many pictures.

    It is as square as can be, and rather wide than high.

    >>> [grid_shape(n) for n in (1, 2, 3, 4, 5, 7, 12)]
    [(1, 1), (1, 2), (2, 2), (2, 2), (2, 3), (3, 3), (3, 4)]
    """
    columns = math.isqrt(max(count, 1) - 1) + 1
    return -(-count // columns), columns


def grid_frame(frames: Sequence[Frame]) -> Frame:
    """Return pictures of one size as one picture, row by row.

    What is left of the last row is black.

    Args:
        frames: `(height, width, 3)` each, uint8; at least one.

    Returns:
        `(rows * height, columns * width, 3)`, uint8; a new array.

    Raises:
        InvalidArgument: there is none, or they differ in size.
    """
    sizes = {frame.shape for frame in frames}
    if len(sizes) != 1:
        shown = ", ".join(f"{shape[1]}x{shape[0]}" for shape in sorted(sizes)) or "none"
        raise InvalidArgument(
            "Pictures side by side in one video must be of one size, got "
            f"{shown}. Give all the same height and width, or make a video of each."
        )
    [(height, width, channels)] = sizes
    rows, columns = grid_shape(len(frames))
    grid = np.zeros((rows, height, columns, width, channels), np.uint8)
    for number, frame in enumerate(frames):
        row, column = divmod(number, columns)
        grid[row, :, column] = frame
    return grid.reshape(rows * height, columns * width, channels)

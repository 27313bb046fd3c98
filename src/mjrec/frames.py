# SPDX-License-Identifier: Apache-2.0
"""What a frame is: a `(height, width, 3) uint8` array of red, green and blue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidArgument, InvalidFrame, UnknownName

Frame: TypeAlias = NDArray[np.uint8]

# The model's own settings; or no multisampling and a small shadow map.
QUALITIES = ("full", "draft")

# H.264 level 6.2 ends here.
_MAX_SIDE = 16384


def check_frame(frame: object, *, size: tuple[int, int] | None = None) -> Frame:
    """Return `frame` if it is a frame.

    Args:
        frame: what an environment gave.
        size: the `(height, width)` that it must have; any, if None.

    Raises:
        InvalidFrame: it is not a `(height, width, 3) uint8` array of that size.
    """
    if not isinstance(frame, np.ndarray):
        raise InvalidFrame(
            "A frame must be a (height, width, 3) uint8 array, got "
            f"{type(frame).__name__}."
        )
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise InvalidFrame(
            "A frame must be a (height, width, 3) uint8 array, got shape "
            f"{frame.shape} and dtype {frame.dtype}."
        )
    if 0 in frame.shape:
        raise InvalidFrame(f"A frame must not be empty, got shape {frame.shape}.")
    if size is not None and frame.shape[:2] != size:
        raise InvalidFrame(
            f"All frames of a video have one size: the first was (height, width) "
            f"{size}, this one is {frame.shape[:2]}."
        )
    return frame


def check_quality(quality: object) -> str:
    """Return `quality` if frames can be drawn so: "full" or "draft".

    Raises:
        UnknownName: it is something else.
    """
    if quality not in QUALITIES:
        raise UnknownName("quality", str(quality), QUALITIES)
    return str(quality)


def check_size(height: int, width: int) -> tuple[int, int]:
    """Return `(height, width)` if a frame can have that size, in pixels.

    Raises:
        InvalidArgument: one is not a whole number from 1 to 16384.
    """
    for name, value in (("height", height), ("width", width)):
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or not 1 <= value <= _MAX_SIDE:
            raise InvalidArgument(
                f"{name} must be a whole number of pixels from 1 to {_MAX_SIDE}, "
                f"got {value!r}."
            )
    return int(height), int(width)


def pad_to_even(frame: Frame) -> Frame:
    """Return `frame` with its last row and column doubled where a side is odd.

    yuv420p has one colour sample for two by two pixels, so the sides of a video are
    even. One repeated edge pixel keeps every other pixel where and as it is.
    """
    height, width = frame.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return frame
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def grid_shape(count: int) -> tuple[int, int]:
    """Return the rows and columns of the grid of N frames.

    It is as square as can be, and rather wide than high.

    >>> [grid_shape(n) for n in (1, 2, 3, 4, 5, 7, 12)]
    [(1, 1), (1, 2), (2, 2), (2, 2), (2, 3), (3, 3), (3, 4)]
    """
    columns = math.isqrt(max(count, 1) - 1) + 1
    return -(-count // columns), columns


def grid_frame(frames: Sequence[Frame]) -> Frame:
    """Return frames of one size as one frame, row by row.

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
            "Frames side by side in one video must be of one size, got "
            f"{shown}. Give all the same height and width, or make a video of each."
        )
    [(height, width, channels)] = sizes
    rows, columns = grid_shape(len(frames))
    grid = np.zeros((rows, height, columns, width, channels), np.uint8)
    for number, frame in enumerate(frames):
        row, column = divmod(number, columns)
        grid[row, :, column] = frame
    return grid.reshape(rows * height, columns * width, channels)

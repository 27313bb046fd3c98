# SPDX-License-Identifier: Apache-2.0
"""Frames: `(height, width, 3) uint8` RGB arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidArgument, InvalidFrame, UnknownName

Frame: TypeAlias = NDArray[np.uint8]

# "full" uses the model's own settings. "draft" uses a small shadow map and no
# multisampling.
QUALITIES = ("full", "draft")

# The limit of H.264 level 6.2.
_MAX_SIDE = 16384


def check_frame(frame: object, *, size: tuple[int, int] | None = None) -> Frame:
    """Return `frame` if it is a valid frame.

    Args:
        frame: the object that an environment returned.
        size: the required `(height, width)`; if None, any size is valid.

    Raises:
        InvalidFrame: `frame` is not a `(height, width, 3) uint8` array of that size.
    """
    if not isinstance(frame, np.ndarray):
        raise InvalidFrame(
            "A frame must be a (height, width, 3) uint8 array, not "
            f"{type(frame).__name__}."
        )
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise InvalidFrame(
            "A frame must be a (height, width, 3) uint8 array, but this one has the "
            f"shape {frame.shape} and the dtype {frame.dtype}."
        )
    if 0 in frame.shape:
        raise InvalidFrame(
            f"A frame must not be empty, but this one has the shape {frame.shape}."
        )
    if size is not None and frame.shape[:2] != size:
        raise InvalidFrame(
            f"All frames of a video must have the same size: the first was (height, "
            f"width) {size}, but this one is {frame.shape[:2]}."
        )
    return frame


def check_quality(quality: object) -> str:
    """Return `quality` if it is "full" or "draft".

    Raises:
        UnknownName: `quality` is anything else.
    """
    if quality not in QUALITIES:
        raise UnknownName("quality", str(quality), QUALITIES)
    return str(quality)


def check_size(height: int, width: int) -> tuple[int, int]:
    """Return `(height, width)` if it is a valid frame size, in pixels.

    Raises:
        InvalidArgument: `height` or `width` is not a whole number from 1 to 16384.
    """
    for name, value in (("height", height), ("width", width)):
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or not 1 <= value <= _MAX_SIDE:
            raise InvalidArgument(
                f"{name} must be a whole number of pixels from 1 to {_MAX_SIDE}, "
                f"not {value!r}."
            )
    return int(height), int(width)


def pad_to_even(frame: Frame) -> Frame:
    """Return `frame` with each odd side extended by repeating its last row or column.

    yuv420p stores one color sample for each block of two by two pixels, so a video's
    sides must be even. Repeating an edge leaves all original pixels unchanged and in
    place.
    """
    height, width = frame.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return frame
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def grid_shape(count: int) -> tuple[int, int]:
    """Return the number of rows and columns in a grid for `count` frames.

    The grid is as square as possible, and never has more rows than columns.

    >>> [grid_shape(n) for n in (1, 2, 3, 4, 5, 7, 12)]
    [(1, 1), (1, 2), (2, 2), (2, 2), (2, 3), (3, 3), (3, 4)]
    """
    columns = math.isqrt(max(count, 1) - 1) + 1
    return -(-count // columns), columns


def grid_frame(frames: Sequence[Frame]) -> Frame:
    """Arrange frames of the same size in a grid, row by row.

    Unused cells in the last row are black.

    Args:
        frames: at least one `(height, width, 3) uint8` array.

    Returns:
        A new `(rows * height, columns * width, 3) uint8` array.

    Raises:
        InvalidArgument: `frames` is empty, or the frames differ in size.
    """
    sizes = {frame.shape for frame in frames}
    if len(sizes) != 1:
        shown = ", ".join(f"{shape[1]}x{shape[0]}" for shape in sorted(sizes)) or "none"
        raise InvalidArgument(
            "Frames that share a video must have the same size, but their sizes are: "
            f"{shown}. Use one height and width for all, or make separate videos."
        )
    [(height, width, channels)] = sizes
    rows, columns = grid_shape(len(frames))
    grid = np.zeros((rows, height, columns, width, channels), np.uint8)
    for number, frame in enumerate(frames):
        row, column = divmod(number, columns)
        grid[row, :, column] = frame
    return grid.reshape(rows * height, columns * width, channels)

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.frames import Frame, grid_frame, grid_shape


def plain(value: int, *, height: int = 2, width: int = 3) -> Frame:
    return np.full((height, width, 3), value, np.uint8)


def test_a_grid_is_as_square_as_can_be() -> None:
    """Every frame is in its place, row by row; the rest is black."""
    for count in range(1, 40):
        rows, columns = grid_shape(count)
        assert rows * columns >= count > (rows - 1) * columns
        assert rows <= columns <= rows + 1
    grid = grid_frame([plain(value) for value in (10, 20, 30)])
    assert grid[::2, ::3, 0].tolist() == [[10, 20], [30, 0]]
    assert (grid == grid[::2, ::3].repeat(2, axis=0).repeat(3, axis=1)).all()


def test_pictures_of_different_sizes_are_an_error_that_names_them() -> None:
    """Nothing is scaled or cut behind the user's back."""
    with pytest.raises(InvalidArgument, match="3x2, 4x5"):
        grid_frame([plain(1), plain(2, height=5, width=4)])

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.frames import Frame, grid_frame, grid_shape


def plain(value: int, *, height: int = 2, width: int = 3) -> Frame:
    return np.full((height, width, 3), value, np.uint8)


@pytest.mark.parametrize("count", range(1, 40))
def test_grid_holds_all_and_no_row_is_empty(count: int) -> None:
    """As square as can be: one column less would be higher than wide."""
    rows, columns = grid_shape(count)
    assert rows * columns >= count > (rows - 1) * columns
    assert rows <= columns <= rows + 1


def test_pictures_stand_row_by_row_and_the_rest_is_black() -> None:
    """Every pixel of every picture is in its place."""
    grid = grid_frame([plain(value) for value in (10, 20, 30)])
    assert grid.shape == (4, 6, 3)
    assert (grid[:2, :3] == 10).all()
    assert (grid[:2, 3:] == 20).all()
    assert (grid[2:, :3] == 30).all()
    assert (grid[2:, 3:] == 0).all()


def test_pictures_of_different_sizes_are_an_error_that_names_them() -> None:
    """Nothing is scaled or cut behind the user's back."""
    with pytest.raises(InvalidArgument, match="3x2, 4x5"):
        grid_frame([plain(1), plain(2, height=5, width=4)])

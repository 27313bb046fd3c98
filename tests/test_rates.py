# SPDX-License-Identifier: Apache-2.0
"""Test exact frame rates."""

from fractions import Fraction

import numpy as np
import pytest

from mjrec import InvalidArgument
from mjrec.rates import MAX_DENOMINATOR, rate_from_timestep, stride_for, to_rate


@pytest.mark.parametrize(
    ("found", "rate"),
    [
        (to_rate(30000 / 1001), Fraction(30000, 1001)),
        (to_rate(Fraction(200, 3)), Fraction(200, 3)),
        (to_rate(np.float32(29.97)), Fraction(2997, 100)),
        (to_rate(np.int64(60)), Fraction(60)),
        (rate_from_timestep(0.015), Fraction(200, 3)),
        (rate_from_timestep(0.1 + 0.2 - 0.25), Fraction(20)),
        (rate_from_timestep(1 / 60), Fraction(60)),
    ],
)
def test_rate_is_an_exact_fraction(found, rate):
    """Numbers of every type, and their sums, become the fraction they stand for."""
    assert found == rate


@pytest.mark.parametrize("fps", [0, -1, float("nan"), True, "30", 1e-9, 1e9])
def test_invalid_rate_is_an_error(fps):
    with pytest.raises(InvalidArgument, match="fps must be"):
        to_rate(fps)


@pytest.mark.parametrize("timestep", [0.0, -0.1, float("nan"), 4e-7, 5e-324])
def test_invalid_timestep_is_an_error(timestep):
    with pytest.raises(InvalidArgument, match="timestep"):
        rate_from_timestep(timestep)


@pytest.mark.parametrize("timestep", [1.234567, 1e-6, 12.3456789])
def test_rate_of_any_timestep_fits_a_video_file(timestep):
    """The fraction's terms are at most a million, and its error at most a millionth."""
    rate = rate_from_timestep(timestep)
    assert max(rate.numerator, rate.denominator) <= MAX_DENOMINATOR
    assert float(rate) * timestep == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize(
    ("rate", "max_fps", "stride"),
    [(20, None, 1), (20, 60, 1), (125, 25, 5), (125, Fraction(249, 10), 6)],
)
def test_stride_is_the_smallest_that_fits(rate, max_fps, stride):
    assert stride_for(Fraction(rate), max_fps) == stride

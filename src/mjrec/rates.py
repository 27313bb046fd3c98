# SPDX-License-Identifier: Apache-2.0
"""Frame rates as exact fractions."""

from __future__ import annotations

import functools
import math
import numbers
from fractions import Fraction

from .errors import InvalidArgument

# The largest denominator in the conversion of a float to the intended fraction (0.05 to
# 1/20). The error is less than 1e-12 seconds.
MAX_DENOMINATOR = 10**6


def to_rate(fps: float | Fraction, *, name: str = "fps") -> Fraction:
    """Return a frame rate as an exact fraction.

    A `Fraction` or an integer is used as is. A float is converted to the closest
    fraction whose denominator is at most a million: 29.97 becomes 2997/100, and the
    float 30000/1001 becomes the fraction 30000/1001.

    Args:
        fps: frames per second.
        name: the argument's name in the error message.

    Raises:
        InvalidArgument: `fps` is not a number, is a bool, NaN, infinite, zero or
            negative, or is outside the range of a video file (1/1000 to 1000000).
    """
    if isinstance(fps, bool) or not isinstance(fps, numbers.Real):
        raise InvalidArgument(
            f"{name} must be a positive number of frames per second, not {fps!r}."
        )
    if not math.isfinite(fps) or fps <= 0:
        raise InvalidArgument(
            f"{name} must be a positive, finite number of frames per second, not {fps}."
        )
    rate = (
        Fraction(fps)
        if isinstance(fps, numbers.Rational)
        # Via the shortest decimal string, so that 29.97 in float32 is also 2997/100.
        else Fraction(str(fps)).limit_denominator(MAX_DENOMINATOR)
    )
    if not Fraction(1, 1000) <= rate <= MAX_DENOMINATOR:
        raise InvalidArgument(
            f"{name} must be from 0.001 to {MAX_DENOMINATOR}, but it is {fps}."
        )
    return rate


# Cached because every episode starts with one of the same few timesteps.
@functools.lru_cache(maxsize=256)
def rate_from_timestep(timestep: float) -> Fraction:
    """Return the rate of one frame every `timestep` seconds.

    Raises:
        InvalidArgument: `timestep` is not a finite number, or is less than a
            microsecond, which no video file can represent.
    """
    if not math.isfinite(timestep) or timestep < 1 / MAX_DENOMINATOR:
        raise InvalidArgument(
            f"A timestep must be at least {1 / MAX_DENOMINATOR:g} seconds, but it is "
            f"{timestep}."
        )
    rate = 1 / Fraction(timestep).limit_denominator(MAX_DENOMINATOR)
    # Steps longer than a second would have numerators too large for a video file.
    return to_rate(rate.limit_denominator(MAX_DENOMINATOR))


def stride_for(rate: Fraction, max_fps: float | Fraction | None) -> int:
    """Return the smallest number of steps between frames that satisfies `max_fps`.

    Args:
        rate: steps per second.
        max_fps: maximum frames per second; None for a frame at every step.

    Raises:
        InvalidArgument: `max_fps` is not a valid rate.
    """
    if max_fps is None:
        return 1
    return math.ceil(rate / to_rate(max_fps, name="max_fps")) or 1

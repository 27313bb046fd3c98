# SPDX-License-Identifier: Apache-2.0
"""Frame rates, as exact fractions."""

from __future__ import annotations

import functools
import math
import numbers
from fractions import Fraction

from .errors import InvalidArgument

# Floats are binary; this finds the fraction that was meant (0.05 is 1/20) and errs by
# less than a millionth of a millionth of a second.
MAX_DENOMINATOR = 10**6


def to_rate(fps: float | Fraction, *, name: str = "fps") -> Fraction:
    """Return `fps` frames per second as an exact fraction.

    A `Fraction` and an integer are taken as they are. A float is taken as the simplest
    fraction that has the same float value to within a millionth: 29.97 is 2997/100 and
    30000/1001 given as a float is 30000/1001.

    Args:
        fps: frames per second.
        name: what the error calls it.

    Raises:
        InvalidArgument: `fps` is not a number, is a bool, NaN, infinite, zero or
            negative, or is outside what a video file can say (1/1000 to 1000000).
    """
    if isinstance(fps, bool) or not isinstance(fps, numbers.Real):
        raise InvalidArgument(
            f"{name} must be a positive number of frames per second, got {fps!r}."
        )
    if not math.isfinite(fps) or fps <= 0:
        raise InvalidArgument(
            f"{name} must be a positive, finite number of frames per second, got {fps}."
        )
    rate = (
        Fraction(fps)
        if isinstance(fps, numbers.Rational)
        # By its shortest text, so that float32's 29.97 is 2997/100 too.
        else Fraction(str(fps)).limit_denominator(MAX_DENOMINATOR)
    )
    if not Fraction(1, 1000) <= rate <= MAX_DENOMINATOR:
        raise InvalidArgument(
            f"{name} must be from 0.001 to {MAX_DENOMINATOR}, got {fps}."
        )
    return rate


# The same few timesteps come at the beginning of every episode.
@functools.lru_cache(maxsize=256)
def rate_from_timestep(timestep: float) -> Fraction:
    """Return the rate of one frame every `timestep` seconds.

    Raises:
        InvalidArgument: `timestep` is not a finite number, or is less than a
            microsecond, which no video file can say.
    """
    if not math.isfinite(timestep) or timestep < 1 / MAX_DENOMINATOR:
        raise InvalidArgument(
            "A timestep must be a number of seconds, at least "
            f"{1 / MAX_DENOMINATOR:g}, got {timestep}."
        )
    rate = 1 / Fraction(timestep).limit_denominator(MAX_DENOMINATOR)
    # Steps of more than a second have numerators that no video file takes.
    return to_rate(rate.limit_denominator(MAX_DENOMINATOR))


def stride_for(rate: Fraction, max_fps: float | Fraction | None) -> int:
    """Return the smallest whole number of steps from one video frame to the next.

    Args:
        rate: steps per second.
        max_fps: the most frames per second that are wanted; None for every step.

    Raises:
        InvalidArgument: `max_fps` is no rate.
    """
    if max_fps is None:
        return 1
    return math.ceil(rate / to_rate(max_fps, name="max_fps")) or 1

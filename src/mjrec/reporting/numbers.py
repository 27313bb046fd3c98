# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them, in columns."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

# What stands where there is no number.
NOTHING: Final = "\N{EN DASH}"


def decimals_for(values: Iterable[float | None]) -> int:
    """Return how many decimals show what is to be seen of numbers of this size."""
    known = [abs(v) for v in values if v is not None and math.isfinite(v)]
    largest = max(known, default=0.0)
    if largest == 0:
        return 0
    # Four figures of the largest, but never less than whole numbers.
    return min(9, max(0, 3 - math.floor(math.log10(largest))))


def number(value: float | None, decimals: int) -> str:
    """Return a number, from 10 000 on with its thousands apart, or a dash."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) >= 1e15:
        return f"{value:.4g}"
    text = f"{value:.{decimals}f}"
    if float(text) == 0:
        return text.removeprefix("-")
    # Four figures in a row are still seen at once.
    return _grouped(text) if abs(value) >= 10_000 else text


def whole_number(value: int) -> str:
    """Return a whole number likewise."""
    return _grouped(str(value)) if abs(value) >= 10_000 else str(value)


def _grouped(text: str) -> str:
    whole, point, decimals = text.partition(".")
    return (
        f"{int(whole):,}".replace(",", "\N{NARROW NO-BREAK SPACE}") + point + decimals
    )

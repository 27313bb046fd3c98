# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them, in columns."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

__all__ = ["NOTHING", "decimals_for", "number"]

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
    """Return a number with its thousands apart by narrow spaces, or a dash."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) >= 1e15:
        return f"{value:.4g}"
    text = f"{value:,.{decimals}f}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return text.removeprefix("-") if float(f"{value:.{decimals}f}") == 0 else text

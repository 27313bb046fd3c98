# SPDX-License-Identifier: Apache-2.0
"""Formatting of numbers, addresses and data for a page."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from typing import Any, Final
from urllib.parse import quote

from ..evaluation.statistics import Interval

# Shown in place of a missing number.
NOTHING: Final = "\N{EN DASH}"

_DATA: Final = re.compile(r"data:(video|image)/[a-z0-9.+-]+;base64,[A-Za-z0-9+/=]*")
_SPECIAL: Final = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def decimals_for(values: Iterable[float | None]) -> int:
    """Return the number of decimals suitable for numbers of this size."""
    known = [abs(v) for v in values if v is not None and math.isfinite(v)]
    largest = max(known, default=0.0)
    if largest == 0:
        return 0
    # Four significant digits for the largest number, but always all digits before the
    # decimal point.
    return min(9, max(0, 3 - math.floor(math.log10(largest))))


def number(value: float | None, decimals: int) -> str:
    """Return a number as a string; a dash for None and NaN.

    From 10,000 up, digits are grouped in thousands.
    """
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) >= 1e15:
        return f"{value:.4g}"
    # Four digits are easy to read without a separator.
    group = "," if abs(value) >= 10_000 else ""
    text = f"{value:z{group}.{decimals}f}"
    return text.replace(",", "\N{NARROW NO-BREAK SPACE}")


def interval_text(interval: Interval | None, decimals: int) -> str:
    """Return an interval as a string, `LOW to HIGH`; empty for None."""
    if interval is None:
        return ""
    return f"{number(interval.low, decimals)} to {number(interval.high, decimals)}"


def address(path: str) -> str:
    """Return the address of a file next to the page, even for an unusual name."""
    if _DATA.fullmatch(path):
        return path
    # With "./" in front, even `javascript:x` and `//host/x` are only file names.
    quoted = quote(path.removeprefix("./"), safe="/", errors="surrogateescape")
    return f"./{quoted}"


def page_json(value: Any) -> str:
    """Return JSON that cannot close the HTML element that contains it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return text.translate(_SPECIAL)

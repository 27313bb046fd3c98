# SPDX-License-Identifier: Apache-2.0
"""Human-readable text: counts, short lists, and escaped text from untrusted sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

# Newlines and the spaces between digits are harmless, although unprintable.
_SEEN: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"


def spelled_out(text: str, longest: int = 1000) -> str:
    """Return text with invisible characters escaped, truncated if it is too long.

    Invisible characters include control characters and marks that change the direction
    of the text.

    Args:
        text: the text to show.
        longest: maximum number of characters to keep.
    """
    if len(text) > longest:
        text = f"{text[:longest]}…"
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in _SEEN else f"\\u{ord(c):04x}" for c in text
    )


def counted(count: int, unit: str) -> str:
    """Return a count with its unit: "1 step", "12 steps", "2 frame hashes"."""
    if count == 1:
        return f"1 {unit}"
    if unit.endswith("y"):
        return f"{count:,} {unit[:-1]}ies"
    return f"{count:,} {unit}{'es' if unit.endswith('sh') else 's'}"


def listed(
    items: Sequence[object],
    most: int,
    *,
    count: int | None = None,
    between: str = ", ",
) -> str:
    """Return the first few items: "a, b and 2 more".

    Args:
        items: the items, or just the first ones.
        most: maximum number of items to list.
        count: the total number of items, if not all are given.
        between: the text between two items.
    """
    shown = between.join(map(str, items[:most]))
    more = (len(items) if count is None else count) - most
    return f"{shown} and {more} more" if more > 0 else shown

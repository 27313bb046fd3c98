# SPDX-License-Identifier: Apache-2.0
"""Texts for people: numbers of things, and what strangers wrote."""

from __future__ import annotations

from typing import Final

# Spaces between figures, which are no stranger's trick, and the ends of lines.
_SEEN: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"


def spelled_out(text: str, longest: int = 1000) -> str:
    """Return a text with what is not seen spelled out, and cut where it is long.

    Control characters and marks that turn the direction of writing are not seen.
    """
    if len(text) > longest:
        text = f"{text[:longest]}…"
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in _SEEN else f"\\u{ord(c):04x}" for c in text
    )


def counted(count: int, unit: str) -> str:
    """Return a number of things: "1 step", "12 steps", "2 frame hashes"."""
    if count == 1:
        return f"1 {unit}"
    if unit.endswith("y"):
        return f"{count:,} {unit[:-1]}ies"
    return f"{count:,} {unit}{'es' if unit.endswith('sh') else 's'}"

# SPDX-License-Identifier: Apache-2.0
"""Texts of strangers, made plain for a page."""

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

# SPDX-License-Identifier: Apache-2.0
"""How many of something, in words."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Return `1 video`, `2 videos`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"

# SPDX-License-Identifier: Apache-2.0
"""What the options of a view say, on any command's line."""

from __future__ import annotations

import re

from ..errors import InvalidArgument
from ..frames import check_size


def size_of(text: str | None) -> tuple[int | None, int | None]:
    """Return `(height, width)` of WIDTHxHEIGHT; twice None for None.

    Raises:
        InvalidArgument: it is no size.
    """
    if text is None:
        return None, None
    match = re.fullmatch(r"(\d+)x(\d+)", text.strip(), re.ASCII | re.IGNORECASE)
    if match is None:
        raise InvalidArgument(
            f"--size must be WIDTHxHEIGHT in pixels, such as 640x480, got {text!r}."
        )
    return check_size(int(match[2]), int(match[1]))


def camera_of(text: str | None) -> str | int | None:
    """Return a camera's number, if `text` is a whole number, else its name."""
    return None if text is None else number_or_name(text)


def number_or_name(text: str) -> str | int:
    """Return the number, if `text` is a whole number, else `text`."""
    return int(text) if re.fullmatch(r"-?\d+", text, re.ASCII) else text

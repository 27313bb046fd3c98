# SPDX-License-Identifier: Apache-2.0
"""Sizes of files as people write them: 50M."""

from __future__ import annotations

import re

from ...errors import InvalidArgument

_SIZE = re.compile(
    r"(?P<number>\d{1,15}(\.\d{1,6})?)\s*(?P<unit>[KMGT]?)(?P<bin>i?)B?", re.IGNORECASE
)
_UNITS = ("", "K", "M", "G", "T")


def byte_count(size: int | str) -> int:
    """Return a size in bytes.

    K, M, G and T are powers of 1000, as those who limit uploads count; Ki, Mi, Gi and
    Ti are powers of 1024.

    >>> byte_count("50M"), byte_count("1.5 KiB"), byte_count(7)
    (50000000, 1536, 7)

    Raises:
        InvalidArgument: it is no size, or less than a byte.
    """
    bytes_ = _parsed(size)
    if bytes_ is None or bytes_ < 1:
        raise InvalidArgument(
            "max_size is a number of bytes, or a text such as '50M' (a million each) "
            f"or '50Mi' (1024 * 1024 each), got {size!r}."
        )
    return bytes_


def shown_size(size: int) -> str:
    """Return a number of bytes as people read it.

    >>> shown_size(52_345_678), shown_size(999)
    ('52.3 MB', '999 bytes')
    """
    for power in range(len(_UNITS) - 1, 0, -1):
        if size >= 1000**power:
            return f"{size / 1000**power:.3g} {_UNITS[power].replace('K', 'k')}B"
    return f"{size} bytes"


def _parsed(size: object) -> int | None:
    if isinstance(size, int) and not isinstance(size, bool):
        return size
    match = _SIZE.fullmatch(size.strip()) if isinstance(size, str) else None
    if match is None or (match["bin"] and not match["unit"]):
        return None
    base = 1024 if match["bin"] else 1000
    return int(float(match["number"]) * base ** _UNITS.index(match["unit"].upper()))

# SPDX-License-Identifier: Apache-2.0
"""File names that mean the same thing wherever their archive is unpacked.

On every system, such a name refers to a file below the folder that the archive is
unpacked into, and two different names refer to two different files.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

# Limits in bytes of UTF-8 that every current file system accepts.
_LONGEST_NAME = 1000
_LONGEST_PART = 255
_DEEPEST = 16

_DRIVE = re.compile(r"[A-Za-z]:")
_LONGEST_SHOWN = 200


def portable_parts(name: str) -> tuple[str, ...]:
    """Return the parts of a relative name, folders first.

    Raises:
        ValueError: the name could lead out of its folder on some system, or is invalid
            on some system.
    """
    parts = tuple(name.split("/"))
    reason = _objection(name, parts)
    if reason is not None:
        raise ValueError(f"the name {name[:_LONGEST_SHOWN]!r} {reason}")
    return parts


def check_distinct(names: Iterable[str]) -> None:
    """Check that no two names clash on any system, as files or as file and folder.

    Some systems do not distinguish upper case from lower case, or composed from
    decomposed accents.

    Raises:
        ValueError: two names collide; the message contains both.
    """
    files: dict[str, str] = {}
    folders: dict[str, str] = {}
    for name in names:
        alike = unicodedata.normalize("NFC", name).casefold()
        if alike in files:
            raise ValueError(
                f"{files[alike][:_LONGEST_SHOWN]!r} and {name[:_LONGEST_SHOWN]!r} are "
                "the same file on some systems"
            )
        files[alike] = name
        parts = alike.split("/")[:-1]
        for depth in range(len(parts)):
            folders.setdefault("/".join(parts[: depth + 1]), name)
    for alike in files.keys() & folders.keys():
        raise ValueError(
            f"{files[alike][:_LONGEST_SHOWN]!r} is both a file and the folder of "
            f"{folders[alike][:_LONGEST_SHOWN]!r}"
        )


def _objection(name: str, parts: tuple[str, ...]) -> str | None:
    """Return the problem with a name, or None."""
    try:
        sizes = [len(part.encode()) for part in parts]
    except UnicodeEncodeError:
        return "is not a valid file name"
    if name.startswith("/") or _DRIVE.match(name):
        return "is absolute and leads out of the folder that it is unpacked into"
    if ".." in parts:
        return "leads out of the folder that it is unpacked into"
    if "\\" in name or not name.isprintable():
        return "contains a backslash or an invisible character"
    if "" in parts or "." in parts:
        return "has an empty part"
    if max(sizes) > _LONGEST_PART or sum(sizes) + len(sizes) > _LONGEST_NAME:
        return "is too long"
    if len(parts) > _DEEPEST:
        return f"is more than {_DEEPEST} folders deep"
    return None

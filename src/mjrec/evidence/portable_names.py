# SPDX-License-Identifier: Apache-2.0
"""Names of files inside an archive that mean the same wherever it is unpacked.

Whatever system reads it, such a name stands for a file below the folder that the
archive is unpacked into, and two of them stand for two files.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

# In bytes of UTF-8: what every file system of today takes.
_LONGEST_NAME = 1000
_LONGEST_PART = 255
_DEEPEST = 16

_DRIVE = re.compile(r"[A-Za-z]:")
_LONGEST_SHOWN = 200


def portable_parts(name: str) -> tuple[str, ...]:
    """Return the parts of a relative name, folders first.

    Raises:
        ValueError: it could lead out of its folder on some system, or could not be
            there on another.
    """
    parts = tuple(name.split("/"))
    reason = _objection(name, parts)
    if reason is not None:
        raise ValueError(f"the name {name[:_LONGEST_SHOWN]!r} {reason}")
    return parts


def check_distinct(names: Iterable[str]) -> None:
    """Check that no two names stand for one file, and none for a file and a folder.

    Some systems do not tell upper case from lower case, or an accent from a letter
    with an accent.

    Raises:
        ValueError: two do; they are named.
    """
    files: dict[str, str] = {}
    folders: dict[str, str] = {}
    for name in names:
        alike = unicodedata.normalize("NFC", name).casefold()
        if alike in files:
            raise ValueError(
                f"{files[alike][:_LONGEST_SHOWN]!r} and {name[:_LONGEST_SHOWN]!r} are "
                "one file on some systems"
            )
        files[alike] = name
        parts = alike.split("/")[:-1]
        for depth in range(len(parts)):
            folders.setdefault("/".join(parts[: depth + 1]), name)
    for alike in files.keys() & folders.keys():
        raise ValueError(
            f"{files[alike][:_LONGEST_SHOWN]!r} is a file, and a folder of "
            f"{folders[alike][:_LONGEST_SHOWN]!r}"
        )


def _objection(name: str, parts: tuple[str, ...]) -> str | None:
    """Return what is wrong with a name; None where nothing is."""
    try:
        sizes = [len(part.encode()) for part in parts]
    except UnicodeEncodeError:
        return "is no text that a file can be called"
    if name.startswith("/") or _DRIVE.match(name):
        return "is absolute: it leads out of the folder that it is unpacked into"
    if ".." in parts:
        return "leads out of the folder that it is unpacked into"
    if "\\" in name or not name.isprintable():
        return "has a backslash or a character in it that cannot be seen"
    if "" in parts or "." in parts:
        return "has an empty part"
    if max(sizes) > _LONGEST_PART or sum(sizes) + len(sizes) > _LONGEST_NAME:
        return "is too long"
    if len(parts) > _DEEPEST:
        return f"is more than {_DEEPEST} folders deep"
    return None

# SPDX-License-Identifier: Apache-2.0
"""What `mjrec verify --json` has said of recordings, read back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ..formats.json_fields import (
    boolean,
    field,
    integer,
    mapping,
    one_of,
    read_object,
    text,
    unreadable,
)
from .contents import Verdict

# Where it is looked for, in each directory with recordings.
VERIFICATION_NAME: Final = "verification.json"

_FAIL: Final = "fail"
_VERDICTS: Final = ("pass", _FAIL, "not checkable")
_LEVELS: Final = ("files", "stats", "physics", "pixels")


def read_verdict(path: Path) -> Verdict:
    """Return what a file says that `mjrec verify --json` has printed.

    Raises:
        UnreadableFile: it is missing, damaged, something else, or contradicts itself.
    """
    with unreadable(path):
        said = read_object(path)
        counts = field(said, "counts", _counts)
        passed = field(said, "passed", boolean)
        if passed != (counts[_FAIL] == 0):
            raise ValueError(
                f"it says passed is {str(passed).lower()}, and that {counts[_FAIL]} "
                "checks failed"
            )
        return Verdict(
            source=f"{field(said, 'path', text)} ({path})",
            passed=passed,
            counts=counts,
            level=field(said, "level", one_of(*_LEVELS)),
        )


def _counts(value: Any) -> Mapping[str, int]:
    counts = {name: field(mapping(value), name, integer) for name in _VERDICTS}
    if min(counts.values()) < 0:
        raise ValueError("a count is negative")
    return counts

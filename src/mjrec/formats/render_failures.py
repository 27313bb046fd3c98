# SPDX-License-Identifier: Apache-2.0
"""Why a video is still pending: `<video>.failed.json`, beside where it will be.

::

    {"reason": "no OpenGL backend works here: ..."}

It is written when rendering has failed, and removed once the video is there.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from .. import json_text
from ..atomic_files import write_text
from ..errors import Error
from .json_fields import read_object

FAILED = ".failed.json"

# What ffmpeg or a driver says can be long; what matters is where it begins and ends.
_LONGEST_REASON = 1000
_CUT = " [...] "


def failure_path(video: Path) -> Path:
    """Return the name of the file that says why a video could not be rendered.

    Args:
        video: or a part of a clip, whose video may not be known.
    """
    return video.with_suffix(FAILED)


def note_failure(video: Path, reason: str) -> None:
    """Write down why a video could not be rendered, as far as that can be written."""
    with contextlib.suppress(Error, OSError):
        text = json_text.dumps({"reason": _shortened(reason)})
        write_text(failure_path(video), text)


def forget_failure(video: Path) -> None:
    """Remove what was said of a video that is there now."""
    with contextlib.suppress(OSError):
        failure_path(video).unlink(missing_ok=True)


def reason_of(video: Path) -> str | None:
    """Return why a video could not be rendered; None where it has not failed."""
    try:
        reason = read_object(failure_path(video)).get("reason")
    except (OSError, ValueError):
        return None
    return reason if isinstance(reason, str) else None


def _shortened(reason: str) -> str:
    if len(reason) <= _LONGEST_REASON:
        return reason
    half = (_LONGEST_REASON - len(_CUT)) // 2
    return f"{reason[:half]}{_CUT}{reason[-half:]}"

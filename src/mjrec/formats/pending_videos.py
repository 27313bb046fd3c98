# SPDX-License-Identifier: Apache-2.0
"""How a manifest names a video that is still to be rendered."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# What ffmpeg or a driver says can be long; what matters is where it begins and ends.
_LONGEST_REASON = 1000
_CUT = " [...] "


def pending_video(episode_id: int, *, trajectory: str, video: str) -> dict[str, Any]:
    """Return the entry of a video.

    Args:
        episode_id: the episode's number.
        trajectory: the base name of its trajectory without extension.
        video: the base name that the video will have.
    """
    return {"episode_id": episode_id, "trajectory": trajectory, "video": video}


def pending_clip(episode_id: int, *, first_part: str, video: str) -> dict[str, Any]:
    """Return the entry of a video that is counted in steps.

    Args:
        episode_id: the number of the episode in which it began.
        first_part: what its first part is called.
        video: the base name that the video will have.
    """
    return {"episode_id": episode_id, "clip": first_part, "video": video}


def with_reason(
    entry: Mapping[str, Any], reasons: Mapping[str, str]
) -> Mapping[str, Any]:
    """Return an entry that says why rendering it has failed, if that is known.

    Args:
        entry: as `pending_video` or `pending_clip` returns it.
        reasons: by the base names of videos, or of trajectories.
    """
    recording = str(entry.get("clip") or f"{entry.get('trajectory')}.h5")
    reason = reasons.get(str(entry.get("video")), reasons.get(recording))
    return entry if reason is None else {**entry, "reason": _shortened(reason)}


def _shortened(reason: str) -> str:
    if len(reason) <= _LONGEST_REASON:
        return reason
    half = (_LONGEST_REASON - len(_CUT)) // 2
    return f"{reason[:half]}{_CUT}{reason[-half:]}"

# SPDX-License-Identifier: Apache-2.0
"""Whether a video that was drawn live must show what was recorded of its simulation.

Where a trajectory has snapshots, pictures are drawn from them whatever a recording says
of when its video was drawn: an environment that is known shows its simulation and
nothing else. Another one, and any wrapper, may draw what it likes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...environments.made_again import (
    NotMadeAgain,
    RecordedEnvironment,
    is_installed_name,
    recorded_environment,
)
from .shipped_video import ShippedVideo


def why_others_are_shown(video: ShippedVideo, facts: Mapping[str, Any]) -> str | None:
    """Return why a live video may show something else than its snapshots.

    Args:
        video: as its metadata describes it.
        facts: of its trajectory, checked.

    Returns:
        A clause; None where it must show them.
    """
    reason = facts["video"].get("reason") or video.live_reason
    if reason:
        return f"{reason:.500}"
    broken = facts.get("broken_reason") or video.cut_short
    if broken:
        return f"it was cut short: {broken:.300}"
    try:
        environment = recorded_environment(facts)
    except NotMadeAgain as error:
        return str(error)
    return _why_unknown(environment)


def _why_unknown(environment: RecordedEnvironment) -> str | None:
    if environment.wrappers is None:
        return "the recording does not say which wrappers stood around its environment"
    if environment.wrappers:
        return f"wrappers may draw on it: {', '.join(environment.wrappers):.300}"
    if environment.framework == "mjcf" or is_installed_name(environment.id):
        return None
    return f"what {environment.id!r:.100} shows is not known here"


def told_live(reason: str | None) -> str:
    """Return that a video was drawn live, and there is nothing else."""
    why = f", because {reason:.500}" if reason else ""
    return (
        f"it was drawn live, as the environment itself showed it{why}; nothing else "
        "is recorded that it could be drawn from"
    )

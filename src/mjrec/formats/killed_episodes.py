# SPDX-License-Identifier: Apache-2.0
"""How episodes ended if their process was killed before recording the end.

An episode's last row shows whether the episode is complete. If so, only its end is
missing from the journal, and it counts like any other episode. Otherwise, it has
`complete: false` and `reason: "killed"`, keeps all rows up to the kill, and does not
count in the statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .journal import entry_of
from .spans import Recording
from .trajectory import TrajectoryReader, added_up

# The reason why an episode ended if its process was killed.
KILLED = "killed"
# The facts about the end of such an episode, and of its live video.
CUT_BY_KILL = {"complete": False, "reason": KILLED}


def how_it_ended(
    reader: TrajectoryReader, recording: Recording | None
) -> dict[str, Any]:
    """Derive any missing facts about an episode's end from its rows.

    Args:
        reader: the reader of the episode's rows.
        recording: the episode's recording in the row log; None if the log is gone.
    """
    facts = reader.facts
    if "complete" in facts:
        # If the disk had no room for the last rows, the rewards were not added up.
        is_cut = facts.get("reward", 0) is None
        return {"reward": added_up(reader.rewards)} if is_cut else {}
    known: dict[str, Any] = {
        "length": reader.step_count,
        "reward": added_up(reader.rewards),
    }
    if reader.step_count and (reader.terminated[-1] or reader.truncated[-1]):
        # Only the end event is missing, because of a kill or a full disk.
        known |= {
            "complete": True,
            "terminated": bool(reader.terminated[-1]),
            "truncated": bool(reader.truncated[-1]),
            "end_time": _end_time(facts, recording),
        }
    else:
        known |= CUT_BY_KILL
        if "exception" in facts:
            # The rows ended before the process did, because of a full disk.
            known["reason"] = "exception"
    video = facts.get("video")
    is_deferred = isinstance(video, dict) and video.get("recording") == "deferred"
    if is_deferred and not reader.frame_count:
        # Prevent any process from waiting for a video without frames.
        known["broken_reason"] = "the process was killed before its first frame"
    return known


def missing_line(
    facts: Mapping[str, Any], choice: Mapping[str, Any]
) -> tuple[str, Mapping[str, Any]]:
    """Return the kind and facts of the journal line that a killed process left out.

    Args:
        facts: the facts in the episode's trajectory; empty if there is no trajectory.
        choice: the line's `episode_id`, `chosen` and `recording`.
    """
    known = {**facts, **choice}
    try:
        entry_of(known)
        is_complete = facts.get("complete") is True
    except ValueError:
        is_complete = False
    if is_complete:
        return "episode", known
    return "cut", {**choice, "reason": facts.get("reason", KILLED)}


def _end_time(facts: Mapping[str, Any], recording: Recording | None) -> float:
    """Return the approximate time when an episode ended, never before its start.

    The modification time of a mapped file may be updated late or never.
    """
    start, last = facts.get("start_time"), 0.0
    if recording is not None:
        last = recording.last_write
    return max(start, last) if isinstance(start, float) else last

# SPDX-License-Identifier: Apache-2.0
"""How an episode ended whose process was killed before it could say so.

Its last row shows whether it is complete. If so, only its end is missing from the
journal, and it counts like any other. Otherwise it has `complete: false` and `reason:
"killed"`, keeps all rows up to the kill, and is not in the statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .journal import KILLED, entry_of
from .spans import Recording
from .trajectory import TrajectoryReader, added_up


def how_it_ended(
    reader: TrajectoryReader, recording: Recording | None
) -> dict[str, Any]:
    """Return facts about an episode's end from its rows, unless its facts have them.

    Args:
        reader: the episode's rows.
        recording: its recording in the row log; None if the log is gone.
    """
    facts = reader.facts
    if "complete" in facts:
        return {}
    known: dict[str, Any] = {
        "complete": False,
        "length": reader.step_count,
        "reward": added_up(reader.rewards),
    }
    if reader.step_count and (reader.terminated[-1] or reader.truncated[-1]):
        # All of it is there except the end event, which a kill or a full disk
        # prevented.
        known |= {
            "complete": True,
            "terminated": bool(reader.terminated[-1]),
            "truncated": bool(reader.truncated[-1]),
            "end_time": _end_time(facts, recording),
        }
    else:
        known["reason"] = KILLED
    video = facts.get("video")
    is_deferred = isinstance(video, dict) and video.get("recording") == "deferred"
    if is_deferred and not reader.frame_count:
        # So that no process waits for a video without frames.
        known["broken_reason"] = "the process was killed before its first frame"
    return known


def missing_line(
    facts: Mapping[str, Any], choice: Mapping[str, Any]
) -> tuple[str, Mapping[str, Any]]:
    """Return kind and facts of the journal line that a kill prevented.

    Args:
        facts: the facts in the episode's trajectory; empty if it has none.
        choice: `episode_id`, `chosen` and `recording` of the line.
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
    """Return about when an episode ended, not before it began.

    The modification time of a mapped file may be updated late or never.
    """
    start, last = facts.get("start_time"), 0.0
    if recording is not None:
        last = recording.last_write
    return max(start, last) if isinstance(start, float) else last

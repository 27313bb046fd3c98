# SPDX-License-Identifier: Apache-2.0
"""The episodes that a dead monitor left in its logs, made into trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.in_flight import drop_recording
from ..formats.journal import JournalEntry
from ..formats.monitor_directory import episode_of
from ..formats.spans import FORMAT
from ..formats.trajectory import FORMAT_VERSION
from ..formats.trajectory_file import finish_trajectory, open_trajectory
from ..formats.video_metadata import is_done
from ..json_text import loads
from ..rendering.recorded_facts import video_path
from .known_episodes import KnownEpisodes
from .report import RecoveredFile

_LONGEST_LINE = 1 << 26


def finish_log_of_dead(path: Path, known: KnownEpisodes) -> RecoveredFile | None:
    """Give a recording in flight its final form, as far as it goes.

    One that was only to be kept until its video is there, and the video is, is dropped.

    Args:
        path: of the file that it becomes.
        known: what is known of the episodes.

    Returns:
        What became of it; None where it is finished already.

    Raises:
        UnreadableFile: it may not be read; it stays.
        Error: as `finish_trajectory`.
    """
    if path.exists():
        return None
    with open_trajectory(path) as reader:
        facts, steps = dict(reader.header.facts), reader.step_count
    if not facts.get("kept", True) and is_done(video_path(path, facts)):
        # Its renderer died between the two.
        drop_recording(path)
        return RecoveredFile(path.name, "its video is there, removed")
    number = episode_of(path.name)
    entry = None if number is None else known.entry(number)
    if "complete" in facts:
        path = finish_trajectory(path)
    elif entry is not None and entry.length == steps:
        # All of it is there but the last words.
        path = finish_trajectory(path, facts=_ending(entry))
    else:
        path = finish_trajectory(path)
        return RecoveredFile(path.name, f"{_count(steps)}, incomplete: killed")
    return RecoveredFile(path.name, _count(steps))


def set_aside(spans: Path) -> RecoveredFile:
    """Give a list of spans that cannot be read a name that nobody looks for.

    Raises:
        UnreadableFile: it is of a newer format; it stays.
    """
    with spans.open("rb") as file:
        line = file.readline(_LONGEST_LINE)
    if _is_newer(line):
        raise UnreadableFile(spans, "it was written by a newer mjrec: update mjrec")
    damaged = spans.with_name(f"{spans.name}.damaged")
    spans.replace(damaged)
    return RecoveredFile(damaged.name, "cannot be read, set aside")


def _is_newer(line: bytes) -> bool:
    try:
        values = loads(line)
    except ValueError:
        return False
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        return False
    version = values.get("version")
    return isinstance(version, int) and version > FORMAT_VERSION


def _ending(entry: JournalEntry) -> dict[str, Any]:
    return {
        "complete": True,
        "terminated": entry.terminated,
        "truncated": entry.truncated,
        "length": entry.length,
        "reward": entry.reward,
        "end_time": entry.end_time,
    }


def _count(steps: int) -> str:
    return f"{steps} {'step' if steps == 1 else 'steps'}"

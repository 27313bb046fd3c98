# SPDX-License-Identifier: Apache-2.0
"""The logs of a dead monitor's episodes, made into trajectories."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import JournalEntry
from ..formats.monitor_directory import episode_of
from ..formats.trajectory import FORMAT_VERSION
from ..formats.trajectory_file import finish_trajectory
from ..formats.trajectory_log import FIRST_LINE, FIRST_LINE_SIZE
from ..formats.trajectory_log_reader import TrajectoryLogReader
from ..formats.video_metadata import is_done
from ..rendering.log_finishing import finish_log
from ..rendering.videos import video_path
from .known_episodes import KnownEpisodes
from .report import RecoveredFile


def finish_log_of_dead(log: Path, known: KnownEpisodes) -> RecoveredFile | None:
    """Give a log its final form, as far as it goes.

    One that is empty is removed. One that cannot be read is set aside: its name gets
    `.damaged` for an ending, so that nobody takes it for a log any more. One that was
    only to be kept until its video is there, and the video is, is removed.

    Returns:
        What became of it; None where it was gone.

    Raises:
        UnreadableFile: it is of a newer format, or may not be read; it stays.
        Error: as `finish_log`.
    """
    try:
        if log.stat().st_size == 0:
            log.unlink()
            return RecoveredFile(log.name, "empty, removed")
    except FileNotFoundError:
        return None
    try:
        facts, steps = _look_at(log)
    except UnreadableFile as error:
        return _set_aside(log, error)
    if not facts.get("kept", True) and is_done(video_path(log, facts)):
        # Its renderer died between the two.
        log.with_suffix(".h5").unlink(missing_ok=True)
        log.unlink(missing_ok=True)
        return RecoveredFile(log.name, "its video is there, removed")
    number = episode_of(log.name)
    entry = None if number is None else known.entry(number)
    if "complete" in facts:
        path = finish_log(log)
    elif entry is not None and entry.length == steps:
        # All of it is there but the last words.
        path = finish_trajectory(log, facts=_ending(entry))
    else:
        path = finish_log(log)
        return RecoveredFile(path.name, f"{_count(steps)}, incomplete: killed")
    return RecoveredFile(path.name, _count(steps))


def _look_at(log: Path) -> tuple[dict[str, Any], int]:
    with TrajectoryLogReader(log) as reader:
        return dict(reader.header.facts), reader.step_count


def _ending(entry: JournalEntry) -> dict[str, Any]:
    return {
        "complete": True,
        "terminated": entry.terminated,
        "truncated": entry.truncated,
        "length": entry.length,
        "reward": entry.reward,
        "end_time": entry.end_time,
    }


def _set_aside(log: Path, error: UnreadableFile) -> RecoveredFile:
    if isinstance(error.__cause__, OSError) or _is_newer(log):
        raise error
    damaged = log.with_name(f"{log.name}.damaged")
    log.replace(damaged)
    return RecoveredFile(damaged.name, f"cannot be read ({error.reason}), set aside")


def _is_newer(log: Path) -> bool:
    with log.open("rb") as file:
        line = file.read(FIRST_LINE_SIZE)
    number = line.removeprefix(FIRST_LINE).strip()
    is_log = line.startswith(FIRST_LINE) and number.isdigit()
    return is_log and int(number) > FORMAT_VERSION


def _count(steps: int) -> str:
    return f"{steps} {'step' if steps == 1 else 'steps'}"

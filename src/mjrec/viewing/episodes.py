# SPDX-License-Identifier: Apache-2.0
"""Search for the episodes in a directory that have recorded states."""

from __future__ import annotations

from pathlib import Path

from ..errors import InvalidArgument
from ..formats.monitor_directory import (
    episode_of,
    recording_directories,
    where_recordings_are,
)
from ..results.monitor_files import MonitorFiles, monitors_of

_SHOWN = 10


def recorded_episodes(directory: Path) -> list[Path]:
    """Return the trajectories in a directory, finished or in flight.

    They are grouped by monitor, with the most recently written monitor last, and sorted
    by episode number.

    Args:
        directory: a monitor directory, or one with several, such as an evaluation.
    """
    places = recording_directories(directory)
    monitors = [files for place in places for files in monitors_of(place)]
    return [
        path
        for files in sorted(monitors, key=_written_at)
        for _, path in sorted(files.trajectories.items())
    ]


def _written_at(files: MonitorFiles) -> int:
    try:
        return 0 if files.journal is None else files.journal.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def trajectory_in(target: Path, episode: int | None) -> Path:
    """Return the requested trajectory: a file, or an episode in a directory.

    Args:
        target: the file or the directory.
        episode: the episode's number; None for the last recorded one. Must be None if
            `target` is a file.

    Raises:
        InvalidArgument: no episode, or more than one, has that number; the directory
            has no recorded states; or `episode` was given with a file.
    """
    if not target.is_dir():
        if episode is not None:
            raise InvalidArgument(
                f"{target} is a single episode. Omit --episode, or give the file's "
                "directory."
            )
        return target
    found = recorded_episodes(target)
    if not found:
        where = where_recordings_are(target)
        raise InvalidArgument(f"{target} contains no recorded states. {where}")
    if episode is None:
        return found[-1]
    those = [path for path in found if episode_of(path.name) == episode]
    if not those:
        known = sorted({str(episode_of(path.name)) for path in found}, key=int)
        raise InvalidArgument(
            f"{target} has no recorded states for episode {episode}. Available: "
            f"{', '.join(known[:_SHOWN])}{' ...' if len(known) > _SHOWN else ''}."
        )
    if len(those) > 1:
        raise InvalidArgument(
            f"Several monitors have an episode {episode}. Instead of the directory, "
            f"give one of these files: {', '.join(map(str, those[:_SHOWN]))}."
        )
    return those[0]

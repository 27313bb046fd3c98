# SPDX-License-Identifier: Apache-2.0
"""Which episodes of a directory have recorded states."""

from __future__ import annotations

from pathlib import Path

from ..errors import InvalidArgument
from ..formats.monitor_directory import episode_of, where_recordings_are
from ..results.monitor_files import monitors_of

_SHOWN = 10


def recorded_episodes(directory: Path) -> list[Path]:
    """Return the trajectories of a monitor directory, finished or in flight.

    They come monitor after monitor, in the order of their numbers.
    """
    return [
        path
        for files in monitors_of(directory)
        for _, path in sorted(files.trajectories.items())
    ]


def trajectory_in(target: Path, episode: int | None) -> Path:
    """Return the trajectory that is meant: a file, or an episode of a directory.

    Args:
        target: the file or the directory.
        episode: the number; None for the last that is recorded.

    Raises:
        InvalidArgument: there is none of that number, or there are several.
    """
    if not target.is_dir():
        if episode is not None:
            raise InvalidArgument(
                f"{target} is one episode: leave --episode out, or name its directory."
            )
        return target
    found = recorded_episodes(target)
    if not found:
        where = where_recordings_are(target)
        raise InvalidArgument(f"{target} holds no recorded states. {where}")
    if episode is None:
        return found[-1]
    those = [path for path in found if episode_of(path.name) == episode]
    if not those:
        known = sorted({str(episode_of(path.name)) for path in found}, key=int)
        raise InvalidArgument(
            f"No states of episode {episode} are recorded in {target}. Recorded: "
            f"{', '.join(known[:_SHOWN])}{' ...' if len(known) > _SHOWN else ''}."
        )
    if len(those) > 1:
        names = ", ".join(path.name for path in those[:_SHOWN])
        raise InvalidArgument(f"Several monitors have episode {episode}: name {names}.")
    return those[0]

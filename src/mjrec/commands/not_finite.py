# SPDX-License-Identifier: Apache-2.0
"""The line with which commands show NaN and infinite returns."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path

from ..errors import Error
from ..formats.monitor_directory import recording_directories
from ..plain_text import counted, listed
from ..results import Episode, iter_episodes
from .terminal import printable

# Follows the number of returns where the option exists.
ALLOWED = " (--allow-nan accepts them)"


def not_finite_lines(names: Sequence[str], more: str = "") -> list[str]:
    """Return the line about episodes whose return is NaN or infinite, if any.

    Args:
        names: names of the episodes.
        more: text after their number.
    """
    which = f"{counted(len(names), 'return')}{more}: {printable(listed(names, 1))}"
    return [f"NaN or infinite: {which}"] * bool(names)


def name_of(directory: Path, episode: Episode) -> str:
    """Return the name for people of an episode in a monitor directory."""
    return f"{directory.name} episode {episode.episode_id}"


def not_finite_in(directory: Path) -> list[str]:
    """Return the names of a directory's episodes whose return is NaN or infinite."""
    # A command has already shown the files that cannot be read.
    with contextlib.suppress(Error):
        return [
            name_of(place, each)
            for place in recording_directories(directory)
            for each in iter_episodes(place)
            if not math.isfinite(each.reward)
        ]
    return []

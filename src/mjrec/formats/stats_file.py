# SPDX-License-Identifier: Apache-2.0
"""The statistics file, gym's "episode batch".

`openaigym.episode_batch.<infix>.stats.json`, keys in the order of `StatsFile`. The
lists have one item for each completed episode. Gym itself wrote one type for each
*reset*, so that its `episode_types` can be longer than the other lists; they are
read as they stand.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from ..atomic_files import write_text
from ..json_text import dumps
from .json_fields import (
    field,
    integer,
    list_of,
    number,
    optional,
    read_object,
    text,
    unreadable,
)


@dataclass(frozen=True)
class StatsFile:
    """What one monitor counted.

    Attributes:
        initial_reset_timestamp: when the first reset began; None before it.
        timestamps: when each episode ended.
        episode_lengths: steps of each episode.
        episode_rewards: sum of the rewards of each episode.
        episode_types: `"t"` for training, `"e"` for evaluation; None in files of
            before there were types.
    """

    initial_reset_timestamp: float | None
    timestamps: tuple[float, ...]
    episode_lengths: tuple[int, ...]
    episode_rewards: tuple[float, ...]
    episode_types: tuple[str, ...] | None

    def to_json(self) -> str:
        """Return the content of the file."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        if self.episode_types is None:
            del values["episode_types"]
        return dumps(values)


def read_stats_file(path: Path) -> StatsFile:
    """Return what the file holds; `null` among the rewards is NaN.

    Raises:
        UnreadableFile: it is missing or damaged, or its lists differ in length.
    """
    with unreadable(path):
        values = read_object(path)
        stats = StatsFile(
            # Absent in the first of all gyms.
            initial_reset_timestamp=field(
                values, "initial_reset_timestamp", optional(number), default=None
            ),
            timestamps=field(values, "timestamps", list_of(number)),
            episode_lengths=field(values, "episode_lengths", list_of(integer)),
            episode_rewards=field(values, "episode_rewards", list_of(number)),
            episode_types=field(
                values, "episode_types", optional(list_of(text)), default=None
            ),
        )
        _check_lengths(stats)
    return stats


def write_stats_file(path: Path, stats: StatsFile) -> None:
    """Write the file, whole or not at all."""
    write_text(path, stats.to_json())


def _check_lengths(stats: StatsFile) -> None:
    counts = {
        "timestamps": len(stats.timestamps),
        "episode_lengths": len(stats.episode_lengths),
        "episode_rewards": len(stats.episode_rewards),
    }
    if len(set(counts.values())) > 1:
        each = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise ValueError(f"its lists belong together but differ in length: {each}")
    if (
        stats.episode_types is not None
        and len(stats.episode_types) < counts["timestamps"]
    ):
        raise ValueError(
            f"it has {len(stats.episode_types)} episode_types for "
            f"{counts['timestamps']} episodes"
        )

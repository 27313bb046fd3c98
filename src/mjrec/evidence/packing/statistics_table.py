# SPDX-License-Identifier: Apache-2.0
"""The statistics of a packed run as CSV: a row for each complete episode."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from ... import json_text
from ...formats.json_fields import read_object, unreadable
from ...results import Episode, iter_episodes
from ..layout import STATISTICS_COLUMNS


def write_statistics(recordings: Path, path: Path) -> None:
    """Write the table of the episodes of a monitor directory.

    Its columns are `layout.STATISTICS_COLUMNS`. The episodes come in the order of
    `iter_episodes`. Numbers are written so that reading them gives the same bits;
    what is not known is empty; truth is `true` or `false`; a seed is JSON.

    Raises:
        UnreadableFile: a file is damaged.
    """
    with path.open("x", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(STATISTICS_COLUMNS)
        for episode in iter_episodes(recordings):
            writer.writerow(map(_cell, _values(episode)))


def _values(episode: Episode) -> tuple[object, ...]:
    return (
        episode.monitor,
        episode.episode_id,
        episode.type,
        episode.length,
        float(episode.reward),
        episode.start_time,
        episode.end_time,
        None if episode.seed is None else json_text.dumps(episode.seed),
        episode.terminated,
        episode.truncated,
        None if episode.video is None else episode.video.name,
        _metadata(episode).get("file_sha256"),
        None if episode.trajectory is None else episode.trajectory.name,
    )


def _metadata(episode: Episode) -> Any:
    if episode.video is None or episode.metadata is None:
        return {}
    with unreadable(episode.metadata):
        return read_object(episode.metadata)


def _cell(value: object) -> str:
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case float():
            return repr(value)
        case _:
            return str(value)

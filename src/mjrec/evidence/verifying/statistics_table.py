# SPDX-License-Identifier: Apache-2.0
"""Whether a packed run's table of statistics says what its recordings say."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...formats.journal import JournalEntry
from ...formats.regular_files import read_regular
from ...json_text import dumps
from ..layout import STATISTICS_COLUMNS
from ..verification import Check, Level
from .findings import Findings
from .recorded_monitors import RecordedMonitor

_LARGEST = 1 << 28


def check_table(path: Path, monitors: Iterable[RecordedMonitor]) -> Iterator[Check]:
    """Yield what is found about a table of the episodes of all monitors.

    Args:
        path: of the CSV file.
        monitors: what is recorded, in any order.
    """
    found = Findings(Level.STATS, f"{path.name} says what the journals say")
    try:
        rows = list(_rows(path))
    except (OSError, ValueError, csv.Error) as error:
        found.look(path.name, f"it cannot be read: {error}")
        yield from found.checks()
        return
    by_infix = {monitor.infix: monitor for monitor in monitors}
    expected = {
        (infix, str(entry.episode_id)): entry
        for infix, monitor in by_infix.items()
        for entry in monitor.entries or ()
    }
    for row in rows:
        infix, number = row["monitor"], row["episode_id"]
        subject = f"episode {number[:20]} of {infix[:100]}"
        known = by_infix.get(infix)
        entry = expected.pop((infix, number), None)
        if known is not None and entry is not None:
            found.look(subject, *_differences(row, _cells(known, entry)))
        elif known is not None and known.entries is None:
            found.cannot_tell(f"recording {infix[:100]} has no journal")
        else:
            found.look(subject, "there is a row of it, and no line in a journal")
    for infix, number in expected:
        found.look(f"episode {number} of {infix}", "there is no row of it")
    yield from found.checks(passed=f"{len(rows)} episodes")


def _rows(path: Path) -> Iterator[Mapping[str, str]]:
    text = read_regular(path, limit=_LARGEST).decode("utf-8")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    if tuple(next(reader, ())) != STATISTICS_COLUMNS:
        raise ValueError(f"its columns are not {', '.join(STATISTICS_COLUMNS)}")
    for cells in reader:
        if len(cells) != len(STATISTICS_COLUMNS):
            raise ValueError(f"line {reader.line_num} has {len(cells)} cells")
        yield dict(zip(STATISTICS_COLUMNS, cells, strict=True))


def _cells(monitor: RecordedMonitor, entry: JournalEntry) -> Mapping[str, Any]:
    """Return what a row must say of an episode, but for the columns that name it."""
    number = entry.episode_id
    video = monitor.files.videos.get(number)
    trajectory = monitor.files.trajectories.get(number)
    digest = None
    for recorded in monitor.videos:
        if video is not None and recorded.name == video.name:
            digest = recorded.metadata.get("file_sha256")
    return {
        "type": entry.type,
        "length": entry.length,
        "reward": entry.reward,
        "start_time": entry.start_time,
        "end_time": entry.end_time,
        "seed": None if entry.seed is None else dumps(entry.seed),
        "terminated": entry.terminated,
        "truncated": entry.truncated,
        "video": None if video is None else video.name,
        "video_sha256": digest,
        "trajectory": None if trajectory is None else trajectory.name,
    }


def _differences(row: Mapping[str, str], cells: Mapping[str, Any]) -> Iterator[str]:
    for column, value in cells.items():
        if not _is_written(value, row[column]):
            said = row[column][:60]
            yield f"{column}: the row says {said!r}, the recording {value!r:.60}"


def _is_written(value: object, text: str) -> bool:
    if value is None:
        return text == ""
    if isinstance(value, bool):
        return text == str(value).lower()
    if not isinstance(value, float):
        return text == str(value)
    try:
        number = float(text)
    except ValueError:
        return False
    return number == value or (math.isnan(number) and math.isnan(value))

# SPDX-License-Identifier: Apache-2.0
"""Finding the numbers of episodes that a statistics file has and a journal lacks.

A statistics file says when episodes ended and not which number they had. A journal
that lacks some of them (a damaged line, a disk that was full for a while) gives the
numbers of the others, and often leaves just as many in between as are missing.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from ..formats.journal import JournalEntry
from ..formats.stats_file import StatsFile


@dataclass(frozen=True)
class NumberedEpisode:
    """An episode of a statistics file.

    Attributes:
        index: its place in the statistics file.
        episode_id: its number, or the lowest that it may have had.
        is_certain: whether it can have had no other number.
        entry: what the journal says of it; None where it lacks it.
    """

    index: int
    episode_id: int
    is_certain: bool
    entry: JournalEntry | None


def number_episodes(
    stats: StatsFile,
    entries: Iterable[JournalEntry],
    *,
    first: int,
    following: int | None,
) -> Iterator[NumberedEpisode]:
    """Yield the episodes of `stats`, in its order.

    Args:
        stats: has them all.
        entries: the journal, which has some of them.
        first: the lowest number that there may be.
        following: one more than the highest; None where that is not known.
    """
    matches = _matches(stats, entries)
    low = first
    for is_missing, group in itertools.groupby(
        enumerate(matches), key=lambda pair: pair[1] is None
    ):
        items = list(group)
        if not is_missing:
            for index, entry in items:
                assert entry is not None
                yield NumberedEpisode(index, entry.episode_id, True, entry)
                low = entry.episode_id + 1
            continue
        after = items[-1][0] + 1
        entry = matches[after] if after < len(matches) else None
        high = following if entry is None else entry.episode_id
        is_certain = high is not None and high - low == len(items)
        for number, (index, _) in enumerate(items, start=low):
            yield NumberedEpisode(index, number, is_certain, None)


def _matches(
    stats: StatsFile, entries: Iterable[JournalEntry]
) -> Sequence[JournalEntry | None]:
    """Return the journal's entry for each episode of `stats`."""
    # Both are written from the same numbers, which JSON gives back exactly.
    by_end = {(entry.end_time, entry.length): entry for entry in entries}
    return [
        by_end.pop(end, None)
        for end in zip(stats.timestamps, stats.episode_lengths, strict=True)
    ]

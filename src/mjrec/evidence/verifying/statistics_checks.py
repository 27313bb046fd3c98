# SPDX-License-Identifier: Apache-2.0
"""The level `stats`: the statistics follow from the rewards, the videos from the rule.

Everything is compared as it is written, bit for bit: a return is the sum of the
recorded rewards, one after the other in float64, as the recorder adds them up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...errors import UnreadableFile
from ...formats.journal import JournalEntry
from ...formats.trajectory import TrajectoryReader
from ...formats.trajectory_file import open_trajectory
from ..layout import ENVIRONMENT, STATISTICS
from ..verification import Check, Level
from .choice_checks import check_choice
from .environment_file_checks import check_environment_file
from .findings import Findings
from .recorded_monitors import RecordedMonitor, RecordedVideo, recorded_monitors
from .repeated_episodes import RepeatedEpisodes
from .statistics_table import check_table
from .task import Count, Task

_MOST_NUMBERS = 20


def check_statistics(
    task: Task, count: Count, *, is_packed: bool = False
) -> Iterator[Check]:
    """Yield what is found about statistics, and about which episodes have videos.

    Args:
        task: what is asked for.
        count: told how many trajectories are looked at.
        is_packed: beside the recordings stand a table of the same statistics, and what
            they were made with.
    """
    monitors = list(recorded_monitors(task.recordings))
    total = sum(len(monitor.files.trajectories) for monitor in monitors)
    done = itertools.count(1)
    for monitor in monitors:
        yield from _check_counts(monitor)
        yield from _check_journal(monitor)
        yield from _check_numbers(monitor)
        yield from _check_trajectories(monitor, lambda: count(next(done), total))
        yield from _check_metadata(monitor)
        yield from check_choice(monitor)
    if is_packed:
        payload = task.recordings.parent
        yield from check_table(payload / STATISTICS, monitors)
        yield from check_environment_file(payload / ENVIRONMENT, monitors)


def same(one: Any, other: Any) -> bool:
    """Tell whether two values out of JSON are equal, NaN being equal to itself."""
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    return bool(one == other)


def sum_of(rewards: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Return the sum of rewards, added up one after the other.

    Python's own `sum` compensates for rounding from 3.12 on, and NumPy's adds in pairs.
    """
    with np.errstate(all="ignore"):
        return 0.0 + float(np.add.accumulate(rewards)[-1]) if len(rewards) else 0.0


def _check_counts(monitor: RecordedMonitor) -> Iterator[Check]:
    found = _findings(monitor, "statistics file and journal can be read")
    for name, reason in monitor.reasons.items():
        found.look(name, f"it cannot be read: {reason}")
    if monitor.manifest is None:
        missing = "it has no manifest: it is still recorded, or was killed"
        found.look(monitor.infix, f"{missing} (mjrec recover)")
    if monitor.stats is not None:
        found.look(monitor.infix)
    yield from found.checks()


def _check_journal(monitor: RecordedMonitor) -> Iterator[Check]:
    """Compare each line of the journal with the row of the statistics file."""
    stats, entries = monitor.stats, monitor.entries
    found = _findings(
        monitor, "journal and statistics file say the same of every episode"
    )
    if stats is None:
        return
    if entries is None:
        if monitor.files.journal is None and len(stats.timestamps):
            found.cannot_tell("it has no journal: another program wrote it")
        yield from found.checks()
        return
    if len(entries) != len(stats.timestamps):
        found.fail(
            f"recording {monitor.infix}",
            f"the journal has {len(entries)} episodes and the statistics file "
            f"{len(stats.timestamps)}",
        )
    elif monitor.dropped:
        found.cannot_tell(f"{monitor.dropped} lines of the journal are no episodes")
    for objection in _other_name(monitor):
        found.fail(f"recording {monitor.infix}", objection)
    types = stats.episode_types or ("t",) * len(stats.timestamps)
    for entry, *row in zip(
        entries,
        stats.episode_lengths,
        stats.episode_rewards,
        types,
        stats.timestamps,
        strict=False,
    ):
        found.look(
            _episode(monitor, entry.episode_id),
            *_differences(
                {
                    "length": (entry.length, row[0]),
                    "return": (entry.reward, row[1]),
                    "type": (entry.type, row[2]),
                    "end": (entry.end_time, row[3]),
                },
                "the journal",
                "the statistics file",
            ),
        )
    yield from found.checks(passed=f"bit for bit, {len(entries)} episodes")


def _other_name(monitor: RecordedMonitor) -> Iterator[str]:
    said = monitor.journal_env_id
    if said is not None and monitor.manifest is not None:
        env_id = monitor.manifest.env_info.get("env_id", said)
        pairs = {"env_id": (said, env_id)}
        yield from _differences(pairs, "the journal", "the manifest")


def _check_numbers(monitor: RecordedMonitor) -> Iterator[Check]:
    """Look for episodes that are not there, and times that cannot be."""
    entries = monitor.entries
    if not entries:
        return
    times = _findings(monitor, "the episodes follow one another in time")
    before = -math.inf
    for entry in entries:
        if not before <= entry.end_time or not entry.start_time <= entry.end_time:
            times.cannot_tell(
                f"{_episode(monitor, entry.episode_id)} ends before it, or the one "
                "before it, begins: the clock was set, or the times are not true"
            )
        else:
            times.look(_episode(monitor, entry.episode_id))
        before = max(before, entry.end_time)
    yield from times.checks()
    yield from _check_gaps(monitor, entries)


def _check_gaps(
    monitor: RecordedMonitor, entries: tuple[JournalEntry, ...]
) -> Iterator[Check]:
    found = _findings(
        monitor, "every episode that was begun is in the statistics, or the last"
    )
    first = monitor.details.get("first_episode_id")
    following = monitor.details.get("next_episode_id")
    numbers = [entry.episode_id for entry in entries]
    if not isinstance(first, int) or not isinstance(following, int):
        return
    if numbers != sorted(numbers) or numbers[0] < first or numbers[-1] >= following:
        found.fail(
            f"recording {monitor.infix}",
            f"the numbers of its episodes do not rise from {first} to {following - 1}, "
            "as the manifest says",
        )
    # The last one may be running when the monitor is closed.
    gaps = _gaps([first - 1, *numbers, following - 1])
    named = list(itertools.islice(gaps, _MOST_NUMBERS))
    if named:
        found.cannot_tell(
            "episodes "
            f"{', '.join(map(str, named))}{' and more' * (len(named) == _MOST_NUMBERS)}"
            " were begun and are not in the statistics: they were reset or closed "
            "before their end, or taken out"
        )
    else:
        found.look(monitor.infix)
    yield from found.checks(passed=f"episodes {first} to {numbers[-1]}")


def _gaps(numbers: list[int]) -> Iterator[int]:
    for before, after in itertools.pairwise(numbers):
        yield from range(before + 1, after)


def _check_trajectories(monitor: RecordedMonitor, count: Any) -> Iterator[Check]:
    found = _findings(
        monitor,
        "length, return and end of each episode follow from its recorded rewards",
    )
    entries = {entry.episode_id: entry for entry in monitor.entries or ()}
    repeated = RepeatedEpisodes()
    compared = 0
    for number, path in sorted(monitor.files.trajectories.items()):
        try:
            with open_trajectory(path) as reader:
                objections = list(_objections(monitor, number, reader, entries))
                repeated.note(number, reader)
        except UnreadableFile as error:
            objections = [f"it cannot be read: {error.reason}"]
        found.look(_episode(monitor, number), *objections)
        compared += number in entries
        count()
    without = len(entries) - compared
    if without:
        found.cannot_tell(
            f"the rewards of {without} of {len(entries)} episodes are not here: they "
            "were left out when it was packed, or not recorded (mode='evaluation' "
            "records those of all)"
        )
    yield from found.checks(passed="bit for bit")
    different = _findings(monitor, "no two recorded episodes are the same")
    repeated.look(different)
    yield from different.checks()


def _objections(
    monitor: RecordedMonitor,
    number: int,
    reader: TrajectoryReader,
    entries: Mapping[int, JournalEntry],
) -> Iterator[str]:
    facts = reader.facts
    rewards, total = reader.rewards, sum_of(reader.rewards)
    ends = np.flatnonzero(reader.terminated | reader.truncated)
    yield from _differences(
        {
            "number": (facts.get("episode_id"), number),
            "recording": (facts.get("infix"), monitor.infix),
        },
        "what is inside",
        "its name",
    )
    computed = {
        "length": len(rewards),
        "return": total,
        "terminated": bool(len(ends)) and bool(reader.terminated[-1]),
        "truncated": bool(len(ends)) and bool(reader.truncated[-1]),
    }
    said = {
        "length": facts.get("length"),
        "return": _number(facts.get("reward")),
        "terminated": facts.get("terminated", computed["terminated"]),
        "truncated": facts.get("truncated", computed["truncated"]),
    }
    pairs = {name: (computed[name], said[name]) for name in computed}
    yield from _differences(pairs, "the recorded steps", "its own summary")
    if facts.get("complete") is True and not len(ends):
        yield "it is said to be complete, and no step of it ended it"
    if len(ends) and ends[0] != len(rewards) - 1:
        yield f"it was over at step {ends[0] + 1} and goes on"
    entry = entries.get(number)
    if entry is None:
        if facts.get("complete") is True:
            yield "it is complete, and no line of the journal is of it"
        return
    if facts.get("complete") is not True:
        yield "the journal has it as complete, and what is recorded of it is not"
    journaled: dict[str, Any] = {
        "length": entry.length,
        "return": entry.reward,
        "terminated": entry.terminated,
        "truncated": entry.truncated,
    }
    yield from _differences(
        {name: (computed[name], journaled[name]) for name in computed},
        "the recorded steps",
        "the journal",
    )
    yield from _differences(
        {
            "seed": (facts.get("seed"), entry.seed),
            "options": (facts.get("options"), entry.options),
            "type": (facts.get("type"), entry.type),
            "beginning": (facts.get("start_time"), entry.start_time),
        },
        "its own summary",
        "the journal",
    )
    env_id = (
        None if monitor.manifest is None else monitor.manifest.env_info.get("env_id")
    )
    if env_id is not None and facts.get("env_id") != env_id:
        yield f"it is of {facts.get('env_id')!r:.99}, the manifest of {env_id!r:.99}"


def _check_metadata(monitor: RecordedMonitor) -> Iterator[Check]:
    found = _findings(
        monitor, "each video's metadata is of the episode that its name says"
    )
    entries = {entry.episode_id: entry for entry in monitor.entries or ()}
    for video in monitor.videos:
        if video.metadata:
            entry = entries.get(video.episode_id)
            found.look(video.name, *_metadata_objections(monitor, video, entry))
    yield from found.checks()


def _metadata_objections(
    monitor: RecordedMonitor, video: RecordedVideo, entry: JournalEntry | None
) -> Iterator[str]:
    said = video.metadata
    if said.get("episode_id") != video.episode_id:
        yield (
            f"its metadata is of episode {said.get('episode_id')!r:.30}, and its name "
            f"of episode {video.episode_id}"
        )
        return
    env_id = (
        None if monitor.manifest is None else monitor.manifest.env_info.get("env_id")
    )
    pairs: dict[str, tuple[Any, Any]] = {"env_id": (said.get("env_id", env_id), env_id)}
    # A video that is counted in steps has a length and a return of its own.
    if entry is not None and not video.is_clip:
        of_entry = {
            "length": entry.length,
            "reward": entry.reward,
            "terminated": entry.terminated,
            "truncated": entry.truncated,
            "seed": entry.seed,
            "type": entry.type,
        }
        pairs |= {
            name: (_number(said[name]) if name == "reward" else said[name], value)
            for name, value in of_entry.items()
            if name in said and not video.is_broken
        }
        if said.get("complete") is False and not video.is_broken:
            yield "its metadata says that the episode was cut off, and the journal not"
    yield from _differences(pairs, "its metadata", "the journal")


def _differences(
    pairs: Mapping[str, tuple[Any, Any]], one: str, other: str
) -> Iterator[str]:
    for name, (first, second) in pairs.items():
        if not same(first, second):
            yield f"{name}: {one} says {first!r:.60}, {other} {second!r:.60}"


def _findings(monitor: RecordedMonitor, claim: str) -> Findings:
    return Findings(Level.STATS, claim, whole=f"recording {monitor.infix}")


def _number(value: Any) -> Any:
    """Return a number as it was before it was written: null was NaN."""
    return math.nan if value is None else value


def _episode(monitor: RecordedMonitor, number: int) -> str:
    return f"episode {number} of {monitor.infix}"

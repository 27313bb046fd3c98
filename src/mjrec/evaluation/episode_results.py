# SPDX-License-Identifier: Apache-2.0
"""Episode results, read from the journals in a chunk's directory.

An episode in an evaluation has up to three lines in a journal. The `begun` line is
written before the reset. The line for the end of the episode is either the usual
journal line with an additional field, `evaluation`, or a `failed` line::

    {"begun": {"seed": 7, "episode": 0}}
    {"episode_id": 0, "length": 200, ..., "evaluation": {"seed": 7, "episode": 0,
     "warnings": {"BADQACC": 1}}}
    {"failed": {"seed": 7, "episode": 1, "episode_id": 1, "failure": "...",
     "length": 12, "start_time": 1790000000.0, "seconds": 0.2}}

A monitor records in its journal that it was closed, and a process that is stopped from
outside appends `{"begun": null}`. If none of these lines follows a `begun` line, the
process crashed or was killed during that episode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..formats.journal import JournalEntry, read_journal
from ..formats.json_fields import field as field_of
from ..formats.json_fields import from_json, integer, mapping, text, unreadable
from ..formats.monitor_directory import infix_of, monitor_directories_in
from ..rendering.jobs import RecordingKey
from .plan import Unit, read_plan

_JOURNALS = "openaigym.episodes.*.jsonl"
_AS_RECORDED = (
    *("length", "terminated", "truncated", "success", "episode_id", "start_time"),
)
_UNFINISHED = dict.fromkeys(("total_reward", "terminated", "truncated"))


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """The result of one episode, completed or failed.

    Attributes:
        task: the environment's name.
        seed: the run's seed.
        episode: the episode's number within its run, counted from 0. A run consists of
            the episodes of one task and seed.
        total_reward: the return; None if the episode failed.
        length: number of steps; if the episode failed, the number of steps before the
            failure.
        terminated: whether the task ended the episode; None if the episode failed.
        truncated: whether a limit outside the task ended the episode; None if the
            episode failed.
        success: whether the environment reported success; None if it reported neither
            success nor failure.
        failure: the reason why the episode could not be completed, as a single line;
            None if it was completed.
        warnings: number of MuJoCo warnings, keyed by kind. The kinds are the names in
            `mujoco.mjtWarning` without `mjWARN_`, and only those that occurred are
            included.
        monitor: infix in the file names of the monitor that recorded the episode; None
            if the episode failed before a monitor was created.
        episode_id: the episode's number in its monitor; None if the episode failed
            before the monitor began to record it.
        start_time: when the episode began, in seconds since the Unix epoch; None if
            unknown.
        seconds: wall-clock duration in seconds; None if unknown.
    """

    task: str
    seed: int
    episode: int
    total_reward: float | None
    length: int
    terminated: bool | None
    truncated: bool | None
    success: bool | None = None
    failure: str | None = None
    warnings: Mapping[str, int] = field(default_factory=dict)
    monitor: str | None = None
    episode_id: int | None = None
    start_time: float | None = None
    seconds: float | None = None

    @property
    def reward(self) -> float | None:
        """The return, under the name used by the keep rules."""
        return self.total_reward

    @property
    def name(self) -> str:
        """The name for people."""
        return f"{self.task} seed {self.seed} episode {self.episode}"

    @property
    def unit(self) -> tuple[int, int]:
        """The seed and episode number, which identify the episode within its task."""
        return self.seed, self.episode

    @property
    def key(self) -> RecordingKey | None:
        """The key of the episode's recording; None if it was not recorded."""
        if self.monitor is None or self.episode_id is None:
            return None
        return RecordingKey(self.monitor, self.episode_id)


@dataclass
class ChunkResults:
    """The finished episodes of a chunk.

    Attributes:
        results: results of the finished episodes, keyed by seed and episode number.
        deaths: number of processes that died while running each unfinished episode,
            keyed by seed and episode number.
        is_drawn_live: whether videos were drawn while the episodes ran.
    """

    results: dict[Unit, EpisodeResult] = field(default_factory=dict)
    deaths: Counter[Unit] = field(default_factory=Counter)
    is_drawn_live: bool = False

    @property
    def size(self) -> int:
        """A measure of progress: finished episodes plus process deaths."""
        return len(self.results) + self.deaths.total()


def read_chunk(folder: Path, task: str) -> ChunkResults:
    """Read the finished episodes of a chunk.

    Args:
        folder: the chunk's monitor directory, which does not have to exist.
        task: the environment's name.

    Raises:
        UnreadableFile: a journal cannot be read.
    """
    found = ChunkResults()
    for path in sorted(folder.glob(_JOURNALS)):
        _read(path, task, found)
    for unit in found.results:
        del found.deaths[unit]
    return found


def recorded_results(directory: Path) -> Iterator[tuple[Path, EpisodeResult]]:
    """Yield the finished episodes of an evaluation, with their monitor directories.

    The episodes are in the plan's order, even if the evaluation is unfinished.

    Raises:
        UnreadableFile: the plan or a journal cannot be read.
    """
    plan = read_plan(directory)
    for task in plan.tasks:
        found: list[tuple[Path, EpisodeResult]] = []
        top = directory / task.folder
        for folder in [top, *monitor_directories_in(top)] if top.is_dir() else []:
            results = read_chunk(folder, task.name).results
            found += ((folder, result) for result in results.values())
        place = {seed: index for index, seed in enumerate(plan.seeds)}
        found.sort(key=lambda each: (place.get(each[1].seed, 0), each[1].episode))
        yield from found


def _read(path: Path, task: str, found: ChunkResults) -> None:
    monitor = str(infix_of(path.name))
    running: list[Unit] = []

    def note(kind: str, facts: Any) -> None:
        if kind == "closed":
            running.clear()
        elif kind == "begun":
            # None means that the process was stopped from outside.
            running[:] = [] if facts is None else [_unit(facts)]
        elif kind == "failed":
            running.clear()
            failed = _failed(facts, task, monitor)
            found.results.setdefault(failed.unit, failed)

    with unreadable(path):
        for entry in read_journal(path, on_event=note):
            if entry.evaluation is not None:
                running.clear()
                found.is_drawn_live |= entry.recording == "live"
                result = _completed(entry, entry.evaluation, task, monitor)
                found.results.setdefault(result.unit, result)
    found.deaths.update(running)


def _completed(
    entry: JournalEntry, recorded: Mapping[str, Any], task: str, monitor: str
) -> EpisodeResult:
    seed, episode = _unit(recorded)
    return EpisodeResult(
        task=task,
        seed=seed,
        episode=episode,
        total_reward=entry.reward,
        warnings=field_of(recorded, "warnings", mapping, default={}),
        monitor=monitor,
        seconds=entry.end_time - entry.start_time,
        **{name: getattr(entry, name) for name in _AS_RECORDED},
    )


def _failed(recorded: Mapping[str, Any], task: str, monitor: str) -> EpisodeResult:
    is_known = recorded.get("episode_id") is not None
    facts = {**_UNFINISHED, **recorded, "failure": text(recorded.get("failure"))}
    given = {"task": task, "monitor": monitor if is_known else None}
    return from_json(EpisodeResult, {**facts, **given})


def _unit(recorded: Mapping[str, Any]) -> Unit:
    return field_of(recorded, "seed", integer), field_of(recorded, "episode", integer)

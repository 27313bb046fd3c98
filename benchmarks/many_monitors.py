# SPDX-License-Identifier: Apache-2.0
"""Create directories with the files of thousands of monitors, almost without recording.

A single monitor records. Its manifest, including the facts about the machine, is then
written under many other infixes with the same functions that monitors use. Statistics
and journals are written in the same way. Trajectory files are empty, because nothing
opens them to read results.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium

import mjrec
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.evaluation import Evaluation, write_results
from mjrec.evaluation.plan import Chunk, EvaluatedTask, EvaluationPlan, write_plan
from mjrec.evaluation.result_tables import EpisodeFiles
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import summarize_results
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.manifest import (
    Manifest,
    StatsFile,
    read_manifest,
    write_manifest,
    write_stats_file,
)
from mjrec.formats.monitor_directory import (
    journal_name,
    manifest_name,
    stats_prefix,
    trajectory_prefix,
)

TASK = "InvertedPendulum-v5"

_CHUNK = "seed-000"
_START = 1.79e9
_SECONDS = 0.5
_STEPS = 1000
# The number of monitors in one process. The next monitor gets a new process number.
_OF_ONE_PROCESS = 100
_FIRST_PROCESS = 4711


@dataclass(frozen=True, kw_only=True)
class _Written:
    """A monitor whose files are written.

    Attributes:
        infix: the monitor's infix.
        seed: seed of the monitor's batch.
        first: number of the monitor's first episode, both in the evaluation and in the
            directory.
        episodes: number of episodes that it recorded.
    """

    infix: str
    seed: int
    first: int
    episodes: int

    @property
    def numbers(self) -> range:
        """The numbers of the monitor's episodes."""
        return range(self.first, self.first + self.episodes)


def write_monitors(folder: Path, *, monitors: int, episodes: int) -> None:
    """Write the files that closed monitors of an evaluation leave in a task's folder.

    Args:
        folder: the folder, which is created.
        monitors: number of monitors.
        episodes: number of episodes per monitor.
    """
    _write_monitors(folder, monitors, episodes, _recorded_manifest())


def write_evaluation(
    directory: Path, *, tasks: int, monitors: int, episodes: int
) -> None:
    """Write a finished evaluation in which every episode has a trajectory.

    Args:
        directory: the directory, which is created.
        tasks: number of tasks.
        monitors: number of monitors per task.
        episodes: number of episodes per monitor.
    """
    planned = [EvaluatedTask(f"{TASK}/{n}", f"task{n}") for n in range(tasks)]
    plan = EvaluationPlan(
        tasks=tuple(planned),
        policy="random",
        seeds=(0,),
        episodes=monitors * episodes,
        keep="none",
        chunks=(Chunk(_CHUNK, (0,), 0, monitors * episodes),),
    )
    pattern = _recorded_manifest()
    for task in planned:
        _write_monitors(directory / task.folder / _CHUNK, monitors, episodes, pattern)
    results = {
        task.name: list(results_of(task.name, monitors=monitors, episodes=episodes))
        for task in planned
    }
    folders = {task.name: f"{task.folder}/{_CHUNK}" for task in planned}
    few = Bootstrap(resamples=10)
    write_plan(directory, plan)
    evaluation = Evaluation(
        directory=directory,
        plan=plan,
        summaries=[
            summarize_results(task, each, bootstrap=few)
            for task, each in results.items()
        ],
        across=None,
        bootstrap=few,
        selection={},
        versions={},
    )
    write_results(
        evaluation,
        [result for each in results.values() for result in each],
        lambda result: EpisodeFiles(
            folder=folders[result.task],
            trajectory=f"{_trajectory_of(result)}.h5",
        ),
    )


def results_of(task: str, *, monitors: int, episodes: int) -> Iterator[EpisodeResult]:
    """Yield the results of the episodes that `write_monitors` writes."""
    for written in _monitors(monitors, episodes):
        for number in written.numbers:
            yield _result(task, written, number)


def _trajectory_of(result: EpisodeResult) -> str:
    assert result.monitor is not None
    assert result.episode_id is not None
    return trajectory_prefix(result.monitor, result.episode_id)


def _recorded_manifest() -> Manifest:
    """Return the manifest that a monitor of an evaluation writes on this machine."""
    with tempfile.TemporaryDirectory() as place:
        env = gymnasium.make(TASK)
        monitor: Any = mjrec.Monitor(env, place, False, mode="evaluation", workers=0)
        with monitor:
            monitor.reset(seed=0)
            monitor.step(env.action_space.sample())
        [path] = Path(place).glob("*.manifest.json")
        return read_manifest(path)


def _write_monitors(
    folder: Path, monitors: int, episodes: int, pattern: Manifest
) -> None:
    folder.mkdir(parents=True)
    for written in _monitors(monitors, episodes):
        _write_monitor(folder, written, pattern)


def _monitors(count: int, episodes: int) -> Iterator[_Written]:
    for number in range(count):
        process, monitor_id = divmod(number, _OF_ONE_PROCESS)
        yield _Written(
            infix=f"{monitor_id}.{_FIRST_PROCESS + process}",
            seed=0,
            first=number * episodes,
            episodes=episodes,
        )


def _write_monitor(folder: Path, written: _Written, pattern: Manifest) -> None:
    entries = [_entry(number) for number in written.numbers]
    writer = JournalWriter(
        folder / journal_name(written.infix), run={"env_info": pattern.env_info}
    )
    for entry in entries:
        writer.append(entry)
        trajectory = trajectory_prefix(written.infix, entry.episode_id)
        (folder / f"{trajectory}.h5").touch()
    writer.close()
    stats = f"{stats_prefix(written.infix)}.stats.json"
    write_stats_file(folder / stats, _stats(entries))
    details = {
        **(pattern.mjrec or {}),
        "first_episode_id": written.first,
        "next_episode_id": written.first + written.episodes,
    }
    manifest = replace(pattern, stats=stats, videos=(), mjrec=details)
    write_manifest(folder / manifest_name(written.infix), manifest)


def _entry(number: int) -> JournalEntry:
    start = _START + number
    return JournalEntry(
        episode_id=number,
        length=_STEPS,
        reward=_reward(number),
        type="e",
        start_time=start,
        end_time=start + _SECONDS,
        seed=number,
        options=None,
        terminated=False,
        truncated=True,
        success=None,
        evaluation={"seed": 0, "episode": number, "warnings": {}},
    )


def _stats(entries: Sequence[JournalEntry]) -> StatsFile:
    return StatsFile(
        initial_reset_timestamp=entries[0].start_time,
        timestamps=tuple(entry.end_time for entry in entries),
        episode_lengths=tuple(entry.length for entry in entries),
        episode_rewards=tuple(entry.reward for entry in entries),
        episode_types=tuple(entry.type for entry in entries),
    )


def _result(task: str, written: _Written, number: int) -> EpisodeResult:
    return EpisodeResult(
        task=task,
        seed=written.seed,
        episode=number,
        total_reward=_reward(number),
        length=_STEPS,
        terminated=False,
        truncated=True,
        monitor=written.infix,
        episode_id=number,
        start_time=_START + number,
        seconds=_SECONDS,
    )


def _reward(number: int) -> float:
    # The values rarely repeat and have about as many digits as real returns.
    return number * 7919 % 10_007 / 13

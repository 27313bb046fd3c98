# SPDX-License-Identifier: Apache-2.0
"""The results of an evaluation, and the files that store them.

::

    directory/
    ├── evaluation.json     the plan, written before anything runs
    ├── results.json        plan, chosen videos, summaries, versions; written last
    ├── results.csv         one row per episode
    ├── timing.csv          wall-clock times and files of the same episodes
    └── <task>/<chunk>/     monitor directories, a few per task

`results.json` and `results.csv` depend only on the plan and on the installed packages.
They are byte-identical for any number of workers, no matter how often the evaluation
was killed and resumed. `result_tables` describes the tables.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TextIO

from ..atomic_files import replacing, writing
from ..errors import UnreadableFile
from ..formats.json_fields import from_json, integer, text, to_json, unreadable
from ..formats.notebook import shown
from ..formats.spans import find_trajectory
from .episode_results import EpisodeResult, recorded_results
from .plan import PLAN_NAME, EvaluationPlan, read_versioned, write_versioned
from .result_tables import (
    EpisodeFiles,
    TaskResults,
    read_tables,
    write_results_table,
    write_timing_table,
)
from .statistics import Bootstrap, Interval
from .summaries import AcrossTasks, TaskSummary

RESULTS_NAME = "results.json"
_TABLE_NAME = "results.csv"
_TIMING_NAME = "timing.csv"
_UNFINISHED = "the evaluation is not finished; mjrec evaluate --resume {} continues it"
_NO_EVALUATION = "the directory contains no evaluation"
RESULT_NAMES = (RESULTS_NAME, _TABLE_NAME, _TIMING_NAME, PLAN_NAME)


class ChosenEpisode(NamedTuple):
    """An episode that was chosen for a video.

    Attributes:
        seed: the seed of the episode's run.
        episode: the episode's number in the run.
        role: the part of the keep rule that chose the episode: `"best"`, `"median"`,
            `"worst"`, `"failure"`, `"cubic"` or `"all"`.
    """

    seed: int
    episode: int
    role: str


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The results of an evaluation, as stored in its directory.

    Attributes:
        directory: the evaluation's directory.
        plan: the plan of the evaluation.
        summaries: summaries of the tasks, in the plan's order.
        across: the summary of all tasks that have a scale; None if it was not computed.
        bootstrap: settings for the confidence intervals.
        selection: the episodes that were chosen for videos, by task.
        versions: versions of the packages used, keyed by package name.
        by_task: the episodes of each task, in the plan's order.
        videos: paths of the finished videos. Only set by a run; empty if the results
            were read from files.
        pending: reasons why chosen videos are missing, keyed by the videos' future
            paths. Only set by a run; empty if the results were read from files.
    """

    directory: Path
    plan: EvaluationPlan
    summaries: Sequence[TaskSummary]
    across: AcrossTasks | None
    bootstrap: Bootstrap
    selection: Mapping[str, Sequence[ChosenEpisode]]
    versions: Mapping[str, str]
    by_task: Mapping[str, TaskResults] = dataclasses.field(default_factory=dict)
    videos: Sequence[Path] = ()
    pending: Mapping[Path, str] = dataclasses.field(default_factory=dict)

    def __iter__(self) -> Iterator[EpisodeResult]:
        """Yield the episodes in the plan's order, without their warnings."""
        for columns in self.by_task.values():
            yield from columns

    @functools.cached_property
    def results(self) -> Sequence[EpisodeResult]:
        """All episodes, in the plan's order, without their warnings."""
        return list(self)

    def _repr_html_(self) -> str:
        """Return HTML for notebooks: a row for each task, and the finished videos."""
        facts = {"episodes": len(self.results), "directory": self.directory}
        level = f"{100 * self.bootstrap.confidence:g}%"
        columns = ("task", "episodes", "mean", level, "IQM", "success", "failed")
        rows = [
            (
                *(each.task, each.episodes, each.mean, _extent(each.mean_interval)),
                *(each.iqm, each.success_rate, each.failed),
            )
            for each in self.summaries
        ]
        return shown("Evaluation", facts, self.videos, columns=columns, rows=rows)

    @property
    def failed(self) -> Sequence[EpisodeResult]:
        """The episodes that could not be completed."""
        return [each for each in self.results if each.failure is not None]

    @property
    def not_finite(self) -> Sequence[EpisodeResult]:
        """The completed episodes whose return is NaN or infinite."""
        returns = ((each, each.total_reward) for each in self.results)
        return [each for each, r in returns if r is not None and not math.isfinite(r)]

    def summary(self, task: str) -> TaskSummary:
        """Return the summary of one task.

        Raises:
            KeyError: the task was not evaluated.
        """
        return {each.task: each for each in self.summaries}[task]

    def folder(self, task: str) -> Path:
        """Return the folder with a task's monitor directories."""
        (name,) = (each.folder for each in self.plan.tasks if each.name == task)
        return self.directory / name

    def file_of(self, result: EpisodeResult) -> Path | None:
        """Return the path of an episode's video, or of its trajectory if there is none.

        The result is None if both files are missing.
        """
        key = result.key
        if key is None:
            return None
        folders = {of: folder for folder, of in self.by_task[result.task].places}
        folder = self.directory / folders[key.infix]
        video = folder / key.video_name
        for each in (video, video.with_suffix(".json")):
            if each.exists():
                return each
        return find_trajectory(folder, key.infix, key.number)


def is_evaluation(directory: Path) -> bool:
    """Return whether a directory contains an evaluation, finished or not."""
    return any((directory / name).is_file() for name in (PLAN_NAME, RESULTS_NAME))


def write_results(
    evaluation: Evaluation,
    results: Sequence[EpisodeResult],
    files: Callable[[EpisodeResult], EpisodeFiles] = lambda _: EpisodeFiles(),
) -> None:
    """Write the results of an evaluation. `results.json` is written last.

    An old `results.json` is removed first, so that the directory never contains the
    tables of one plan together with the summaries of another.

    Args:
        evaluation: the evaluation's data, except the episodes.
        results: the results of all episodes in the plan, in the plan's order.
        files: a function that returns an episode's files.

    Raises:
        FileNotWritten: the disk is full, or the directory is missing or read-only.
    """
    directory, plan = evaluation.directory, evaluation.plan
    content = _ResultsFile(
        # Chunks are left out, because they depend on when episodes were added, which
        # must not change the results.
        plan=replace(plan, chunks=()),
        selection=_Selection(rule=plan.keep, by_task=evaluation.selection),
        bootstrap=evaluation.bootstrap,
        tasks=evaluation.summaries,
        across=evaluation.across,
        versions=evaluation.versions,
    )
    (directory / RESULTS_NAME).unlink(missing_ok=True)
    _write(directory / _TABLE_NAME, lambda file: write_results_table(file, results))
    _write(
        directory / _TIMING_NAME, lambda file: write_timing_table(file, results, files)
    )
    write_versioned(directory / RESULTS_NAME, to_json(content))


def read_results(directory: Path, *, needs_timing: bool = False) -> Evaluation:
    """Read the results in an evaluation's directory.

    The files are untrusted: their sizes, numbers, names and row order are checked, and
    no file outside the directory is opened.

    Args:
        directory: the evaluation's directory.
        needs_timing: whether `timing.csv` must exist. If it is missing and not needed,
            times and files are unknown.

    Raises:
        UnreadableFile: the directory contains no evaluation, the evaluation is not
            finished, or a file is damaged or missing.
    """
    read = read_summaries(directory)
    table, timing = directory / _TABLE_NAME, directory / _TIMING_NAME
    by_task = read_tables(table, timing, read.plan, needs_timing=needs_timing)
    return replace(read, by_task=by_task)


def read_summaries(directory: Path) -> Evaluation:
    """Read the results from `results.json` alone, without the episodes.

    Raises:
        UnreadableFile: the file is missing or damaged.
    """
    path = directory / RESULTS_NAME
    if not path.exists():
        is_begun = (directory / PLAN_NAME).exists()
        reason = _UNFINISHED.format(directory) if is_begun else _NO_EVALUATION
        raise UnreadableFile(path, reason)
    with unreadable(path):
        read = from_json(_ResultsFile, read_versioned(path))
        if [each.task for each in read.tasks] != [
            each.name for each in read.plan.tasks
        ]:
            raise ValueError("its summaries do not match the tasks of its plan")
    return Evaluation(
        directory=directory,
        plan=read.plan,
        summaries=read.tasks,
        across=read.across,
        bootstrap=read.bootstrap,
        selection=read.selection.by_task,
        versions=read.versions,
    )


def results_in(directory: Path) -> Iterator[tuple[EpisodeResult, Path | None]]:
    """Yield the results of a finished or unfinished evaluation, and the videos' paths.

    The episodes are in the plan's order. Paths are None for an unfinished evaluation.

    Raises:
        UnreadableFile: the plan or a journal cannot be read.
    """
    try:
        results = read_results(directory)
    except UnreadableFile:
        yield from ((result, None) for _, result in recorded_results(directory))
        return
    for columns in results.by_task.values():
        for index, result in enumerate(columns):
            video = columns.video_path(index)
            yield result, None if video is None else directory / video


def _write(path: Path, write: Callable[[TextIO], None]) -> None:
    with (
        writing(path),
        replacing(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        write(file)


def _plan(value: Any) -> EvaluationPlan:
    plan = from_json(EvaluationPlan, value)
    for what, values in (
        ("task", [each.name for each in plan.tasks]),
        ("folder", [each.folder for each in plan.tasks]),
        ("seed", plan.seeds),
    ):
        if len(set(values)) < len(values):
            raise ValueError(f"a {what} is listed twice")
    return plan


def _chosen(value: Any) -> ChosenEpisode:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError("a chosen episode must be a list of seed, number and role")
    seed, episode, role = value
    return ChosenEpisode(integer(seed), integer(episode), text(role))


@dataclass(frozen=True, kw_only=True)
class _Selection:
    rule: str
    by_task: Mapping[str, Sequence[Annotated[ChosenEpisode, _chosen]]]


@dataclass(frozen=True, kw_only=True)
class _ResultsFile:
    """The content of `results.json`, in file order."""

    plan: Annotated[EvaluationPlan, _plan]
    selection: _Selection
    bootstrap: Bootstrap
    tasks: Sequence[TaskSummary]
    across: AcrossTasks | None
    versions: Mapping[str, str]


def _extent(interval: Interval | None) -> str:
    return f"{interval.low:.4g} to {interval.high:.4g}" if interval else ""

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
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from ..atomic_files import replacing, write_text, writing
from ..errors import UnreadableFile
from ..formats.json_fields import (
    field,
    from_json,
    integer,
    list_of,
    mapping,
    optional,
    read_object,
    text,
    to_json,
    unreadable,
)
from ..formats.monitor_directory import video_prefix
from ..formats.notebook import shown
from ..formats.spans import find_trajectory
from ..json_text import dumps
from .episode_results import EpisodeResult
from .plan import FORMAT_VERSION, PLAN_NAME, EvaluationPlan
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
RESULT_NAMES = (RESULTS_NAME, _TABLE_NAME, _TIMING_NAME, PLAN_NAME)


@dataclass(frozen=True)
class ChosenEpisode:
    """An episode that was chosen to get a video.

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
        selection: the episodes that were chosen to get a video, by task.
        versions: versions of the packages that were used, by package.
        by_task: the episodes of each task, in the plan's order.
        videos: paths of the finished videos. Only set by a run; empty if the results
            were read from files.
        pending: reasons why chosen videos are missing, keyed by the paths that the
            videos will get. Only set by a run; empty if the results were read from
            files.
    """

    directory: Path
    plan: EvaluationPlan
    summaries: Sequence[TaskSummary]
    across: AcrossTasks | None
    bootstrap: Bootstrap
    selection: Mapping[str, Sequence[ChosenEpisode]]
    versions: Mapping[str, str]
    by_task: Mapping[str, TaskResults]
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
        """Return HTML for notebooks, with a row per task and the finished videos."""
        facts = {"episodes": len(self.results), "directory": self.directory}
        level = f"{100 * self.bootstrap.confidence:g} %"
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
        """Return the path of an episode's video, or of its trajectory without a video.

        Return None if both files are missing.
        """
        infix = result.monitor
        if infix is None or result.episode_id is None:
            return None
        folders = {of: folder for folder, of in self.by_task[result.task].places}
        folder = self.directory / folders[infix]
        video = folder / f"{video_prefix(infix, result.episode_id)}.mp4"
        for each in (video, video.with_suffix(".json")):
            if each.exists():
                return each
        return find_trajectory(folder, infix, result.episode_id)


def is_evaluation(directory: Path) -> bool:
    """Return whether a directory contains an evaluation, finished or not."""
    return any((directory / name).is_file() for name in (PLAN_NAME, RESULTS_NAME))


def write_results(
    directory: Path,
    *,
    plan: EvaluationPlan,
    results: Sequence[EpisodeResult],
    summaries: Sequence[TaskSummary],
    across: AcrossTasks | None,
    bootstrap: Bootstrap,
    selection: Mapping[str, Sequence[ChosenEpisode]],
    versions: Mapping[str, str],
    files: Callable[[EpisodeResult], EpisodeFiles] = lambda _: EpisodeFiles(),
) -> None:
    """Write the results of an evaluation. `results.json` is written last.

    An old `results.json` is removed first, so that the directory never contains the
    tables of one plan together with the summaries of another.

    Args:
        directory: the evaluation's directory.
        plan: the plan of the evaluation.
        results: the results of all episodes in the plan, in the plan's order.
        summaries: summaries of the tasks, in the plan's order.
        across: the summary of all tasks that have a scale, if any.
        bootstrap: settings for the confidence intervals.
        selection: see `Evaluation`.
        versions: see `Evaluation`.
        files: a function that returns the files of an episode.

    Raises:
        FileNotWritten: the disk is full, or the directory is missing or read-only.
    """
    value = {
        "format_version": FORMAT_VERSION,
        # Chunks are left out because they depend on when episodes were added, and that
        # must not change the results.
        "plan": to_json(replace(plan, chunks=())),
        "selection": {
            "rule": plan.keep,
            "by_task": {
                task: [[each.seed, each.episode, each.role] for each in chosen]
                for task, chosen in selection.items()
            },
        },
        "bootstrap": to_json(bootstrap),
        "tasks": [to_json(each) for each in summaries],
        "across": None if across is None else to_json(across),
        "versions": dict(versions),
    }
    (directory / RESULTS_NAME).unlink(missing_ok=True)
    _write(directory / _TABLE_NAME, lambda file: write_results_table(file, results))
    _write(
        directory / _TIMING_NAME, lambda file: write_timing_table(file, results, files)
    )
    write_text(directory / RESULTS_NAME, dumps(value, indent=2) + "\n")


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
        raise UnreadableFile(path, _why_missing(directory))
    with unreadable(path):
        value = read_object(path)
        version = field(value, "format_version", integer)
        if version != FORMAT_VERSION:
            raise ValueError(
                f"it has format version {version}, but this mjrec reads version "
                f"{FORMAT_VERSION}"
            )
        plan = field(value, "plan", _plan)
        tasks = [each.name for each in plan.tasks]
        summaries = field(value, "tasks", list_of(partial(from_json, TaskSummary)))
        if [each.task for each in summaries] != tasks:
            raise ValueError("its summaries do not match the tasks of its plan")
        across = field(value, "across", optional(partial(from_json, AcrossTasks)))
        bootstrap = field(value, "bootstrap", partial(from_json, Bootstrap))
        selection = field(value, "selection", _selection)
        versions = field(value, "versions", _versions)
    return Evaluation(
        directory=directory,
        plan=plan,
        summaries=summaries,
        across=across,
        bootstrap=bootstrap,
        selection=selection,
        versions=versions,
        by_task={},
    )


def _write(path: Path, write: Callable[[TextIO], None]) -> None:
    with (
        writing(path),
        replacing(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        write(file)


def _why_missing(directory: Path) -> str:
    if (directory / PLAN_NAME).exists():
        return (
            "the evaluation is not finished; to continue it, run the same command with "
            "--resume"
        )
    return "the directory contains no evaluation"


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


def _versions(value: Any) -> Mapping[str, str]:
    return {text(name): text(version) for name, version in mapping(value).items()}


def _selection(value: Any) -> Mapping[str, Sequence[ChosenEpisode]]:
    by_task = field(mapping(value), "by_task", mapping)
    read = list_of(_chosen)
    return {text(task): read(chosen) for task, chosen in by_task.items()}


def _chosen(value: Any) -> ChosenEpisode:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError("a chosen episode must be a list of seed, number and role")
    seed, episode, role = value
    return ChosenEpisode(integer(seed), integer(episode), text(role))


def _extent(interval: Interval | None) -> str:
    return f"{interval.low:.4g} to {interval.high:.4g}" if interval else ""

# SPDX-License-Identifier: Apache-2.0
"""Comparison of two evaluations, or sets of evaluations, A and B.

All figures compare B with A: differences are B - A, and the probability of improvement
is the probability that B has a higher return than A. If each side is a single
evaluation, the figures are computed from its episodes and apply only to these two
policies. If a side has several evaluations, one per training run, the figures are
computed from the evaluations' mean returns and apply to the two methods. See
`docs/reference/statistics.md`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from ..errors import InvalidArgument
from . import statistics
from .evaluation import Evaluation, read_results
from .plan import SEEDED
from .result_tables import TaskResults
from .statistics import Bootstrap, Estimate, FloatArray
from .summaries import scaled

Directories: TypeAlias = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

IMPROVEMENT: Final = "probability of improvement"
TASK_FIGURES: Final = (
    *("mean A", "mean B", "difference", "paired difference"),
    *(IMPROVEMENT, "p-value"),
)
"""Names of the figures for one task, in the order used in tables."""
OVERALL_FIGURES: Final = (IMPROVEMENT, "IQM A", "IQM B", "IQM difference")
"""Names of the figures across all tasks, in the order used in tables."""

_MOST_TOLD: Final = 10


@dataclass(frozen=True, kw_only=True)
class TaskComparison:
    """The comparison of A and B on one task. Tuples contain the values for A and B.

    Attributes:
        task: the task's name.
        episodes: number of completed episodes. The figures are computed from these.
        failed: number of failed episodes.
        not_finite: number of completed episodes whose return is NaN or infinite. If a
            side has such episodes, no figures are computed.
        figures: the available figures, keyed by their names in `TASK_FIGURES`. The
            means are averages over episodes or, if a side has several evaluations, over
            the mean returns of the evaluations. The paired difference uses episodes
            that began in the same state. The p-value is from the two-sided Mann-Whitney
            test and is adjusted for the number of tasks by Holm's method.
        pairs: number of episode pairs used for the paired difference.
        unknown: the reason why there are no figures; None if there are figures.
    """

    task: str
    episodes: tuple[int, int]
    failed: tuple[int, int]
    not_finite: tuple[int, int]
    figures: Mapping[str, Estimate]
    pairs: int
    unknown: str | None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The comparison of B with A.

    Attributes:
        a: evaluation directories of A.
        b: evaluation directories of B.
        unit: the unit of resampling: `"episodes"` if each side has one evaluation,
            otherwise `"evaluations"`.
        policies: the policies of A and B.
        cautions: reasons to doubt the figures, such as different conditions or failed
            episodes.
        remarks: other differences, which do not affect the figures.
        left_out: for A and B, the tasks that are missing from an evaluation on the
            other side.
        tasks: the comparison on each common task, in A's order.
        figures: the available figures, keyed by their names in `OVERALL_FIGURES`: the
            probability of improvement, averaged over tasks, and the interquartile means
            of scores.
        scored: tasks that contribute to the scores, because all evaluations use the
            same scale for them.
        bootstrap: settings for the confidence intervals.
    """

    a: tuple[Path, ...]
    b: tuple[Path, ...]
    unit: Literal["episodes", "evaluations"]
    policies: tuple[str, str]
    cautions: tuple[str, ...]
    remarks: tuple[str, ...]
    left_out: tuple[tuple[str, ...], tuple[str, ...]]
    tasks: tuple[TaskComparison, ...]
    figures: Mapping[str, Estimate]
    scored: tuple[str, ...]
    bootstrap: Bootstrap


def compare(
    a: Directories,
    b: Directories,
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Comparison:
    """Compare two evaluations, or two sets of evaluations.

    The figures show how much better B is than A. If each side has one evaluation,
    episodes are resampled, and the figures apply to these two policies. If a side has
    several evaluations (training runs of one method with different seeds), each
    evaluation is represented by its mean return, and the means are resampled for each
    task separately.

    Args:
        a: the evaluation directory of A, or several directories.
        b: the evaluation directory of B, or several directories.
        confidence: confidence level of the intervals.
        resamples: number of bootstrap resamples.
        seed: seed for the bootstrap.

    Raises:
        UnreadableFile: a directory contains no finished evaluation, or the evaluation
            is damaged.
        InvalidArgument: the evaluations have no task in common, a side has no
            directory, or a directory is given twice.
    """
    how = Bootstrap(resamples=resamples, seed=seed, confidence=confidence)
    sides = of_a, of_b = _Side("A", a), _Side("B", b)
    common = [task for task in of_a.tasks if task in of_b.tasks]
    if not common:
        raise InvalidArgument(
            "The evaluations have no task in common: "
            + "; ".join(f"{side.label} has {', '.join(side.tasks)}" for side in sides)
        )
    is_single = len(of_a.results) == len(of_b.results) == 1
    unknown = {task: of_a.unknown(task) or of_b.unknown(task) for task in common}
    samples = {
        task: (of_a.sample(task, is_single), of_b.sample(task, is_single))
        for task, why in unknown.items()
        if why is None
    }
    p_values = holm_adjusted(
        {task: statistics.two_sided_p_value(*both) for task, both in samples.items()}
    )
    tasks = []
    for task in common:
        pairs = np.empty(0)
        figures: dict[str, Estimate] = {}
        if task in samples:
            if is_single:
                pairs = _paired_differences(task, of_a.results[0], of_b.results[0])
            figures = _task_figures(*samples[task], pairs, how)
            figures["p-value"] = Estimate(p_values[task])
        episodes, failed, not_finite = zip(
            of_a.counts(task), of_b.counts(task), strict=True
        )
        tasks.append(
            TaskComparison(
                task=task,
                episodes=episodes,
                failed=failed,
                not_finite=not_finite,
                figures=figures,
                pairs=len(pairs),
                unknown=unknown[task],
            )
        )
    scales = _scales([*of_a.results, *of_b.results])
    scored = tuple(task for task in samples if task in scales)
    return Comparison(
        a=of_a.directories,
        b=of_b.directories,
        unit="episodes" if is_single else "evaluations",
        policies=(of_a.policies(), of_b.policies()),
        cautions=tuple(_cautions(of_a, of_b, tasks)),
        remarks=tuple(
            f"{name}: {in_a} in A, {in_b} in B"
            for name, in_a, in_b in _different(of_a, of_b, _choices)
        ),
        left_out=(of_a.without(common), of_b.without(common)),
        tasks=tuple(tasks),
        figures=_overall_figures(samples, {task: scales[task] for task in scored}, how),
        scored=scored,
        bootstrap=how,
    )


def holm_adjusted(p_values: Mapping[str, float]) -> dict[str, float]:
    """Adjust p-values for multiple comparisons by Holm's method.

    The k-th smallest of m p-values (counted from 0) is multiplied by m - k and capped
    at 1. If the result is smaller than the adjusted value before it, that value is used
    instead. If every adjusted value below 0.05 is reported as a difference, then at
    most 5 in 100 comparisons contain a false positive.
    """
    adjusted: dict[str, float] = {}
    largest = 0.0
    for k, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        largest = max(largest, min(1.0, p_values[name] * (len(p_values) - k)))
        adjusted[name] = largest
    return adjusted


class _Side:
    """The evaluations on one side of a comparison.

    Args:
        name: `"A"` or `"B"`.
        directories: one directory or several.
    """

    def __init__(self, name: str, directories: Directories) -> None:
        if isinstance(directories, str | os.PathLike):
            directories = [directories]
        self.name = name
        self.directories = tuple(map(Path, directories))
        self.label = f"{name} ({', '.join(map(str, self.directories))})"
        if not self.directories:
            raise InvalidArgument(
                f"Side {name} has no evaluation. Give at least one directory."
            )
        if len({path.resolve() for path in self.directories}) < len(self.directories):
            raise InvalidArgument(f"An evaluation was given twice: {self.label}.")
        self.results = [read_results(path) for path in self.directories]
        first, *rest = (each.by_task for each in self.results)
        # The tasks that all evaluations have in common.
        self.tasks = [task for task in first if all(task in other for other in rest)]

    def policies(self) -> str:
        return _listed(each.plan.policy_and_kwargs for each in self.results)

    def without(self, tasks: Sequence[str]) -> tuple[str, ...]:
        """Return this side's tasks, excluding the given ones."""
        return tuple(task for task in self.tasks if task not in tasks)

    def returns(self, task: str) -> list[FloatArray]:
        """Return the returns of completed episodes, one array per evaluation."""
        columns = [each.by_task[task] for each in self.results]
        return [each.rows["total_reward"][~each.failed] for each in columns]

    def sample(self, task: str, is_single: bool) -> FloatArray:
        """Return all returns if `is_single`, otherwise each evaluation's mean."""
        returns = self.returns(task)
        return returns[0] if is_single else np.array([r.mean() for r in returns])

    def counts(self, task: str) -> tuple[int, int, int]:
        """Return the numbers of completed episodes, failures and non-finite returns."""
        failed = sum(len(each.by_task[task].failures) for each in self.results)
        returns = np.concatenate(self.returns(task))
        return len(returns), failed, _not_finite(returns)

    def unknown(self, task: str) -> str | None:
        """Return the reason why a task has no figures, or None if it has figures."""
        for path, returns in zip(self.directories, self.returns(task), strict=True):
            name = self.name if len(self.results) == 1 else path
            if not len(returns):
                return f"no episode of {name} was completed"
            if wrong := _not_finite(returns):
                return (
                    f"{wrong} of {len(returns)} returns of {name} are NaN or infinite"
                )
        return None


def _not_finite(returns: FloatArray) -> int:
    return int(np.count_nonzero(~np.isfinite(returns)))


def _task_figures(
    x: FloatArray, y: FloatArray, pairs: FloatArray, how: Bootstrap
) -> dict[str, Estimate]:
    mean_a, mean_b = statistics.mean(x), statistics.mean(y)
    figures = {"mean A": mean_a, "mean B": mean_b, "difference": mean_b - mean_a}
    if len(pairs):
        figures["paired difference"] = statistics.mean(pairs)
    figures[IMPROVEMENT] = statistics.improvement(y, x)
    return {name: figure.estimate(how) for name, figure in figures.items()}


def _overall_figures(
    samples: Mapping[str, tuple[FloatArray, FloatArray]],
    scales: Mapping[str, tuple[float, float]],
    how: Bootstrap,
) -> dict[str, Estimate]:
    figures = {}
    if samples:
        better = [statistics.improvement(y, x) for x, y in samples.values()]
        figures[IMPROVEMENT] = statistics.average(better)
    if scales:
        iqm_a, iqm_b = (
            statistics.interquartile_mean(
                scaled(samples[task][side], scale) for task, scale in scales.items()
            )
            for side in (0, 1)
        )
        figures |= {"IQM A": iqm_a, "IQM B": iqm_b, "IQM difference": iqm_b - iqm_a}
    return {name: figure.estimate(how) for name, figure in figures.items()}


def _paired_differences(task: str, a: Evaluation, b: Evaluation) -> FloatArray:
    """Return B - A for each pair of episodes that began in the same state."""
    if not (
        a.plan.protocol == b.plan.protocol == SEEDED
        and a.plan.env_kwargs == b.plan.env_kwargs
    ):
        return np.empty(0)
    of_a, of_b = _by_unit(a.by_task[task]), _by_unit(b.by_task[task])
    return np.array([of_b[unit] - of_a[unit] for unit in of_a if unit in of_b])


def _by_unit(columns: TaskResults) -> dict[tuple[int, int], float]:
    done = columns.rows[~columns.failed]
    units = zip(done["seed"], done["episode"], strict=True)
    return dict(zip(units, done["total_reward"].tolist(), strict=True))


def _scales(results: Sequence[Evaluation]) -> dict[str, tuple[float, float]]:
    """Return the score ranges that are the same in all evaluations, keyed by task."""
    said: dict[str, set[tuple[float, float] | None]] = {}
    for each in results:
        for summary in each.summaries:
            said.setdefault(summary.task, set()).add(summary.score_range)
    # The files are untrusted, so the range is checked.
    return {
        task: scale
        for task, (scale, *others) in said.items()
        if not others and scale is not None and scale[0] < scale[1]
    }


def _cautions(a: _Side, b: _Side, tasks: Sequence[TaskComparison]) -> Iterator[str]:
    for side, other in ((a, b), (b, a)):
        if len(side.results) == 1 < len(other.results):
            yield (
                f"{side.name} is a single evaluation, so the variation between "
                "training runs is unknown and there are no intervals"
            )
    for name, of_a, of_b in _different(a, b, _conditions):
        yield (
            f"{name} is {of_a} in A and {of_b} in B, and returns under different "
            "conditions cannot show which policy is better"
        )
    for task in tasks:
        for name, failed, completed in zip(
            "AB", task.failed, task.episodes, strict=True
        ):
            if failed:
                yield (
                    f"{task.task}: {failed} of {failed + completed} episodes of "
                    f"{name} failed; the figures do not include them"
                )


def _conditions(results: Evaluation) -> Mapping[str, object]:
    """Return the conditions that affect a policy's returns."""
    plan = results.plan
    return {"max_steps": plan.max_steps, "env_kwargs": plan.env_kwargs}


def _choices(results: Evaluation) -> Mapping[str, object]:
    """Return the options that select episodes, and the versions of packages."""
    plan = results.plan
    return {
        "protocol": plan.protocol,
        "seeds": tuple(sorted(plan.seeds)),
        "episodes": plan.episodes,
        **results.versions,
    }


def _different(
    a: _Side, b: _Side, facts: Callable[[Evaluation], Mapping[str, object]]
) -> Iterator[tuple[str, str, str]]:
    """Yield each fact that differs between evaluations, and the values in A and B."""
    said = [[facts(each) for each in side.results] for side in (a, b)]
    for name in dict.fromkeys(name for side in said for fact in side for name in fact):
        of_a, of_b = ([fact.get(name, "none") for fact in side] for side in said)
        # Lists, because some values are not hashable.
        if any((value in of_a) != (value in of_b) for value in (*of_a, *of_b)):
            yield name, _listed(of_a), _listed(of_b)


def _listed(values: Iterable[object]) -> str:
    return " or ".join(dict.fromkeys(map(_told, values)))


def _told(value: object) -> str:
    if value is None:
        return "the environment's own"
    if isinstance(value, tuple):
        shown = ", ".join(map(str, value[:_MOST_TOLD]))
        return f"{shown} ..." if len(value) > _MOST_TOLD else shown
    return str(value)

# SPDX-License-Identifier: Apache-2.0
"""Comparing evaluations: how much better B is than A.

Every figure is of B against A: differences are B - A, and the probability of
improvement is that of B having a higher return than A. Where each side is one
evaluation, the figures are of its episodes, and say something of these two policies
only. Where a side is several, one for each training, the figures are of the
evaluations' means, and say something of the two methods: see `docs/statistics.md`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from ..errors import InvalidArgument, MissingDependency
from . import statistics
from .plan import SEEDED
from .result_columns import ResultColumns
from .results_files import ReadResults, read_results
from .statistics import Bootstrap, FloatArray, Interval
from .summaries import scaled

Directories: TypeAlias = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

_MOST_TOLD: Final = 10


@dataclass(frozen=True)
class PairedDifference:
    """How much more B got than A, from the same initial states.

    Attributes:
        episodes: how many seeds and numbers both completed.
        difference: the mean of B - A over them.
        interval: of that, by resampling pairs; None of a single one.
    """

    episodes: int
    difference: float
    interval: Interval | None


@dataclass(frozen=True, kw_only=True)
class TaskComparison:
    """What is said of one task. What cannot be said is None.

    Attributes:
        task: its name.
        episodes_a: how many were completed; the figures are theirs.
        episodes_b: likewise.
        failed_a: how many were not.
        failed_b: likewise.
        not_finite_a: how many of the completed ones have a return that is NaN or
            infinite. Where any has, there are no figures.
        not_finite_b: likewise.
        mean_a: of the returns; of several evaluations that of their means.
        mean_b: likewise.
        difference: `mean_b - mean_a`.
        difference_interval: of that.
        probability: that B is better, where equal returns count half: of an episode of
            B against one of A, or of an evaluation's mean against another's.
        probability_interval: of that.
        p_value: of the two-sided Mann-Whitney test that neither tends to be higher.
        p_value_holm: that, adjusted (Holm) for the number of tasks.
        paired: the same difference from episodes that began alike; None where the two
            evaluations have none.
        interval_method: how the intervals were made.
        unknown: why there are no figures; None where there are.
    """

    task: str
    episodes_a: int
    episodes_b: int
    failed_a: int = 0
    failed_b: int = 0
    not_finite_a: int = 0
    not_finite_b: int = 0
    mean_a: float | None = None
    mean_b: float | None = None
    difference: float | None = None
    difference_interval: Interval | None = None
    probability: float | None = None
    probability_interval: Interval | None = None
    p_value: float | None = None
    p_value_holm: float | None = None
    paired: PairedDifference | None = None
    interval_method: str | None = None
    unknown: str | None = None


@dataclass(frozen=True, kw_only=True)
class ScoreComparison:
    """The interquartile means of the scores of all tasks with one scale everywhere.

    Attributes:
        tasks: which ones.
        iqm_a: the interquartile mean of their scores.
        iqm_b: likewise.
        difference: `iqm_b - iqm_a`.
        interval: of that; None where there is a single score of a task.
    """

    tasks: tuple[str, ...]
    iqm_a: float
    iqm_b: float
    difference: float
    interval: Interval | None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """B against A.

    Attributes:
        a: the directories of the one side.
        b: the directories of the other.
        unit: what the figures are of, and is resampled: `"episodes"` of one evaluation
            on each side, or `"evaluations"`.
        policy_a: what was evaluated in A.
        policy_b: what was evaluated in B.
        cautions: what must be known before the figures are believed: that not all was
            made under the same conditions, or that episodes failed.
        remarks: in what else the two differ; their figures can be compared all the
            same.
        only_in_a: tasks that are not in all evaluations of B.
        only_in_b: tasks that are not in all evaluations of A.
        tasks: those that are everywhere, in the order of A.
        probability: that B is better, averaged over tasks; None where no task has one.
        probability_interval: of that; None also where a task has a single value.
        scores: of all tasks that have the same scale everywhere; None where none has.
        bootstrap: how intervals were made.
    """

    a: tuple[Path, ...]
    b: tuple[Path, ...]
    unit: Literal["episodes", "evaluations"]
    policy_a: str
    policy_b: str
    cautions: tuple[str, ...]
    remarks: tuple[str, ...]
    only_in_a: tuple[str, ...]
    only_in_b: tuple[str, ...]
    tasks: tuple[TaskComparison, ...]
    probability: float | None
    probability_interval: Interval | None
    scores: ScoreComparison | None
    bootstrap: Bootstrap

    @property
    def compared(self) -> tuple[TaskComparison, ...]:
        """The tasks that have figures."""
        return tuple(task for task in self.tasks if task.unknown is None)


def compare(
    a: Directories,
    b: Directories,
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Comparison:
    """Compare two evaluations, or two sets of them; every figure is of B against A.

    Of one evaluation on each side, episodes are resampled: the figures are of these two
    policies. Of several on a side (trainings of one method with different seeds), each
    evaluation counts as its mean return, and these are resampled, for each task on its
    own.

    Args:
        a: the directory of an evaluation, or several.
        b: likewise.
        confidence: the share of intervals that hold the true value.
        resamples: of the bootstrap that intervals come from.
        seed: of its generator.

    Raises:
        UnreadableFile: there is no finished evaluation in a directory, or it is
            damaged.
        InvalidArgument: no task is in all of them, or a directory is there twice.
        MissingDependency: scipy is not installed.
    """
    how = Bootstrap(resamples=resamples, seed=seed, confidence=confidence)
    sides = of_a, of_b = _Side("A", a), _Side("B", b)
    common = [task for task in of_a.tasks if task in of_b.tasks]
    if not common:
        raise InvalidArgument(
            "The evaluations have no task in common: "
            + "; ".join(f"{side.told} has {', '.join(side.tasks)}" for side in sides)
        )
    is_single = len(of_a.results) == len(of_b.results) == 1
    for side in sides:
        side.is_single = is_single
    tasks = [_compared_task(task, of_a, of_b, how) for task in common]
    adjusted = holm_adjusted(
        {each.task: each.p_value for each in tasks if each.p_value is not None}
    )
    known = [each.task for each in tasks if each.unknown is None]
    better = statistics.average(
        statistics.improvement(of_b.sample(task), of_a.sample(task)) for task in known
    )
    return Comparison(
        a=of_a.directories,
        b=of_b.directories,
        unit="episodes" if is_single else "evaluations",
        policy_a=_listed(each.plan.policy for each in of_a.results),
        policy_b=_listed(each.plan.policy for each in of_b.results),
        cautions=tuple(_cautions(of_a, of_b, tasks)),
        remarks=tuple(
            f"{name}: {in_a} in A, {in_b} in B"
            for name, in_a, in_b in _different(of_a, of_b, _choices)
        ),
        only_in_a=tuple(task for task in of_a.tasks if task not in common),
        only_in_b=tuple(task for task in of_b.tasks if task not in common),
        tasks=tuple(
            replace(each, p_value_holm=adjusted.get(each.task)) for each in tasks
        ),
        probability=better.value if known else None,
        probability_interval=better.interval(how) if known else None,
        scores=_compared_scores(of_a, of_b, known, how),
        bootstrap=how,
    )


def holm_adjusted(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values that are adjusted for how many there are.

    The k-th smallest of m (from 0) times m - k, none smaller than one before it, at
    most 1. To call those below 0.05 different is to be wrong about any of them in at
    most 5 of 100 comparisons.
    """
    adjusted: dict[str, float] = {}
    largest = 0.0
    for k, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        largest = max(largest, min(1.0, p_values[name] * (len(p_values) - k)))
        adjusted[name] = largest
    return adjusted


class _Side:
    """The evaluations of one side.

    Args:
        name: `"A"` or `"B"`.
        directories: one, or several.
    """

    def __init__(self, name: str, directories: Directories) -> None:
        if isinstance(directories, str | os.PathLike):
            directories = [directories]
        self.name = name
        self.directories = tuple(map(Path, directories))
        if not self.directories:
            raise InvalidArgument(f"There is no evaluation on the side of {name}.")
        if len({path.resolve() for path in self.directories}) < len(self.directories):
            raise InvalidArgument(f"An evaluation is there twice: {self.told}.")
        self.results = [read_results(path) for path in self.directories]
        # Whether the other side is one evaluation, too.
        self.is_single = True

    @property
    def told(self) -> str:
        return f"{self.name} ({', '.join(map(str, self.directories))})"

    @property
    def tasks(self) -> list[str]:
        """The tasks that are in all evaluations."""
        rest = [each.columns for each in self.results[1:]]
        first = self.results[0].columns
        return [task for task in first if all(task in other for other in rest)]

    def returns(self, task: str) -> list[FloatArray]:
        """Return those of the completed episodes of each evaluation."""
        columns = [each.columns[task] for each in self.results]
        return [each.total_reward[~each.failed] for each in columns]

    def sample(self, task: str) -> FloatArray:
        """Return what the figures are of."""
        returns = self.returns(task)
        if self.is_single:
            return returns[0]
        return np.array([each.mean() for each in returns])

    def failed(self, task: str) -> int:
        return sum(len(each.columns[task].failures) for each in self.results)

    def unknown(self, task: str) -> str | None:
        """Return why there are no figures of a task."""
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


def _compared_task(task: str, a: _Side, b: _Side, how: Bootstrap) -> TaskComparison:
    returns_a, returns_b = (np.concatenate(side.returns(task)) for side in (a, b))
    compared = TaskComparison(
        task=task,
        episodes_a=len(returns_a),
        episodes_b=len(returns_b),
        failed_a=a.failed(task),
        failed_b=b.failed(task),
        not_finite_a=_not_finite(returns_a),
        not_finite_b=_not_finite(returns_b),
        unknown=a.unknown(task) or b.unknown(task),
    )
    if compared.unknown is not None:
        return compared
    x, y = a.sample(task), b.sample(task)
    mean_a, mean_b = statistics.mean(x), statistics.mean(y)
    difference, better = mean_b - mean_a, statistics.improvement(y, x)
    return replace(
        compared,
        mean_a=mean_a.value,
        mean_b=mean_b.value,
        difference=difference.value,
        difference_interval=difference.interval(how),
        probability=better.value,
        probability_interval=better.interval(how),
        p_value=_mann_whitney(x, y),
        paired=_paired(task, a.results[0], b.results[0], how) if a.is_single else None,
        interval_method=difference.interval_method,
    )


def _mann_whitney(x: FloatArray, y: FloatArray) -> float:
    """Return the two-sided p-value; exact for small samples without equal values."""
    try:
        # Here, because it takes longer to import than all else, and is optional.
        from scipy.stats import mannwhitneyu  # type: ignore[import-untyped] # no stubs
    except ImportError as error:
        raise MissingDependency(
            "scipy",
            purpose="Comparing evaluations",
            install='pip install "mjrec[evaluation]"',
        ) from error
    if np.ptp(np.concatenate([x, y])) == 0:
        # SciPy would divide zero by zero.
        return 1.0
    return float(mannwhitneyu(y, x, alternative="two-sided").pvalue)


def _paired(
    task: str, a: ReadResults, b: ReadResults, how: Bootstrap
) -> PairedDifference | None:
    if not (
        a.plan.protocol == b.plan.protocol == SEEDED
        and a.plan.env_kwargs == b.plan.env_kwargs
    ):
        # Episodes of the same seed and number began in different states.
        return None
    of_a, of_b = _by_unit(a.columns[task]), _by_unit(b.columns[task])
    pairs = [of_b[unit] - of_a[unit] for unit in of_a if unit in of_b]
    if not pairs:
        return None
    difference = statistics.mean(np.array(pairs))
    return PairedDifference(len(pairs), difference.value, difference.interval(how))


def _by_unit(columns: ResultColumns) -> dict[tuple[int, int], float]:
    done = ~columns.failed
    units = zip(columns.seed[done], columns.episode[done], strict=True)
    return dict(zip(units, columns.total_reward[done].tolist(), strict=True))


def _compared_scores(
    a: _Side, b: _Side, tasks: Sequence[str], how: Bootstrap
) -> ScoreComparison | None:
    scales = _scales([*a.results, *b.results])
    scaled_tasks = tuple(task for task in tasks if task in scales)
    if not scaled_tasks:
        return None
    iqm_a, iqm_b = (
        statistics.interquartile_mean(
            scaled(side.sample(task), scales[task]) for task in scaled_tasks
        )
        for side in (a, b)
    )
    difference = iqm_b - iqm_a
    return ScoreComparison(
        tasks=scaled_tasks,
        iqm_a=iqm_a.value,
        iqm_b=iqm_b.value,
        difference=difference.value,
        interval=difference.interval(how),
    )


def _scales(results: Sequence[ReadResults]) -> dict[str, tuple[float, float]]:
    """Return the returns that count as 0 and as 1, of tasks where all say the same."""
    said: dict[str, set[tuple[float, float] | None]] = {}
    for each in results:
        for summary in each.summaries:
            said.setdefault(summary.task, set()).add(summary.score_range)
    # A file may say anything.
    return {
        task: scale
        for task, (scale, *others) in said.items()
        if not others and scale is not None and scale[0] < scale[1]
    }


def _cautions(a: _Side, b: _Side, tasks: Sequence[TaskComparison]) -> Iterator[str]:
    for side, other in ((a, b), (b, a)):
        if len(side.results) == 1 < len(other.results):
            yield (
                f"{side.name} is a single evaluation: how much another training would "
                "differ is not known, and there are no intervals"
            )
    for name, of_a, of_b in _different(a, b, _conditions):
        yield (
            f"{name} was {of_a} in A and is {of_b} in B: returns under different "
            "conditions do not tell which policy is better"
        )
    for task in tasks:
        for name, failed, completed in (
            ("A", task.failed_a, task.episodes_a),
            ("B", task.failed_b, task.episodes_b),
        ):
            if failed:
                yield (
                    f"{task.task}: {failed} of {failed + completed} episodes of "
                    f"{name} failed; the figures are of the others"
                )


def _conditions(results: ReadResults) -> Mapping[str, object]:
    """Return what changes returns though the policy is the same."""
    plan = results.plan
    return {"max_steps": plan.max_steps, "env_kwargs": plan.env_kwargs}


def _choices(results: ReadResults) -> Mapping[str, object]:
    """Return what chooses which episodes are seen, and what ran them."""
    plan = results.plan
    return {
        "protocol": plan.protocol,
        "seeds": plan.seeds,
        "episodes": plan.episodes,
        **results.versions,
    }


def _different(
    a: _Side, b: _Side, facts: Callable[[ReadResults], Mapping[str, object]]
) -> Iterator[tuple[str, str, str]]:
    """Yield the facts that are not the same everywhere, as each side says them."""
    results = [*a.results, *b.results]
    for name in dict.fromkeys(name for each in results for name in facts(each)):
        values = [facts(each).get(name, "none") for each in results]
        if any(value != values[0] for value in values):
            split = len(a.results)
            yield name, _listed(values[:split]), _listed(values[split:])


def _listed(values: Iterable[object]) -> str:
    return " or ".join(dict.fromkeys(map(_told, values)))


def _told(value: object) -> str:
    if value is None:
        return "the environment's own"
    if isinstance(value, tuple):
        shown = ", ".join(map(str, value[:_MOST_TOLD]))
        return f"{shown} ..." if len(value) > _MOST_TOLD else shown
    return str(value)

# SPDX-License-Identifier: Apache-2.0
"""Comparing two evaluations: how much better the second one is.

Every figure is of B against A: differences are B - A, and the probability of
improvement is that of an episode of B having a higher return than one of A. What it
says is of these two policies: two trainings of the same method differ as well, and an
evaluation of one policy knows nothing of that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import InvalidArgument, MissingDependency
from . import intervals, statistics
from .plan import SEEDED, EvaluationPlan
from .result_columns import ResultColumns
from .results_files import ReadResults, read_results
from .statistics import FloatArray
from .summaries import Bootstrap, Interval
from .summarizing import scaled

# Of the plan: what changes returns though the policy is the same.
_CONDITIONS: Final = ("max_steps", "env_kwargs")
# What only chooses which episodes are seen.
_CHOICES: Final = ("protocol", "seeds", "episodes")
_MOST_TOLD: Final = 10

# A million of their squares can be added up.
_LARGEST: Final = 1e150


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
        mean_a: of the returns.
        mean_b: likewise.
        difference: `mean_b - mean_a`.
        difference_interval: of that.
        probability: that B is better: of an episode of B having a higher return than
            one of A, where equal returns count half.
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
    """The interquartile means of the scores of all tasks with the same scale in both.

    Attributes:
        tasks: which ones.
        iqm_a: the interquartile mean of their scores.
        iqm_b: likewise.
        difference: `iqm_b - iqm_a`.
        interval: of that; None where a task has a single episode.
    """

    tasks: tuple[str, ...]
    iqm_a: float
    iqm_b: float
    difference: float
    interval: Interval | None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Evaluation B against evaluation A.

    Attributes:
        a: the directory of the one.
        b: the directory of the other.
        policy_a: what was evaluated in A.
        policy_b: what was evaluated in B.
        cautions: what must be known before the figures are believed: that the two were
            not made under the same conditions, or that episodes failed.
        remarks: in what else the two differ; their figures can be compared all the
            same.
        only_in_a: tasks that are not in B.
        only_in_b: tasks that are not in A.
        tasks: those that are in both, in the order of A.
        probability: that B is better, averaged over tasks; None where no task has one.
        probability_interval: of that; None also where a task has a single episode.
        scores: of all tasks that have the same scale in both; None where none has.
        bootstrap: how intervals were made.
    """

    a: Path
    b: Path
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
    a: str | Path, b: str | Path, *, bootstrap: Bootstrap | None = None
) -> Comparison:
    """Compare two evaluations; every figure is of B against A.

    Args:
        a: the directory of an evaluation.
        b: the directory of another.
        bootstrap: how intervals are made; as `Bootstrap()` says, if None.

    Raises:
        UnreadableFile: there is no finished evaluation in a directory, or it is
            damaged.
        InvalidArgument: no task is in both.
        MissingDependency: scipy is not installed.
    """
    return compare_results(
        read_results(Path(a)), read_results(Path(b)), bootstrap or Bootstrap()
    )


def compare_results(a: ReadResults, b: ReadResults, bootstrap: Bootstrap) -> Comparison:
    """Compare two evaluations that have been read; see `compare`."""
    common = [task for task in a.columns if task in b.columns]
    if not common:
        raise InvalidArgument(
            f"The two evaluations have no task in common: {a.directory} is of "
            f"{', '.join(a.columns)}; {b.directory} is of {', '.join(b.columns)}."
        )
    pairs = {task: _Pair(a.columns[task], b.columns[task]) for task in common}
    known = {task: pair for task, pair in pairs.items() if pair.unknown is None}
    returns_a = {task: pair.returns_a for task, pair in known.items()}
    returns_b = {task: pair.returns_b for task, pair in known.items()}
    found = intervals.improvement_intervals(returns_b, returns_a, bootstrap=bootstrap)
    p_values = _mann_whitney(returns_a, returns_b)
    comparison = Comparison(
        a=a.directory,
        b=b.directory,
        policy_a=a.plan.policy,
        policy_b=b.plan.policy,
        cautions=tuple(_cautions(a, b, pairs)),
        remarks=tuple(_remarks(a, b)),
        only_in_a=tuple(task for task in a.columns if task not in pairs),
        only_in_b=tuple(task for task in b.columns if task not in pairs),
        tasks=tuple(
            _compared_task(task, pair, found, bootstrap) for task, pair in pairs.items()
        ),
        probability=(
            statistics.mean_probability_of_improvement(returns_b, returns_a)
            if known
            else None
        ),
        probability_interval=found.mean_probability,
        scores=_compared_scores(a, b, known, bootstrap),
        bootstrap=bootstrap,
    )
    comparison = _with_p_values(comparison, p_values)
    return (
        _with_pairs(comparison, known, bootstrap) if _begin_alike(a, b) else comparison
    )


def holm_adjusted(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values that are adjusted for how many there are.

    The k-th smallest of m (from 0) times m - k, none smaller than one before it, at
    most 1: S. Holm, "A Simple Sequentially Rejective Multiple Test Procedure",
    Scandinavian Journal of Statistics 6 (1979). To call those below 0.05 different is
    to be wrong about any of them in at most 5 of 100 comparisons.
    """
    adjusted: dict[str, float] = {}
    largest = 0.0
    for k, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        largest = max(largest, min(1.0, p_values[name] * (len(p_values) - k)))
        adjusted[name] = largest
    return {name: adjusted[name] for name in p_values}


class _Pair:
    """The episodes of one task in both evaluations."""

    def __init__(self, a: ResultColumns, b: ResultColumns) -> None:
        self.a = a
        self.b = b
        self.returns_a = a.total_reward[~a.failed]
        self.returns_b = b.total_reward[~b.failed]

    @property
    def unknown(self) -> str | None:
        """Why the two cannot be compared."""
        for name, returns in (("A", self.returns_a), ("B", self.returns_b)):
            if not len(returns):
                return f"no episode of {name} was completed"
            wrong = np.count_nonzero(~np.isfinite(returns))
            if wrong:
                return (
                    f"{wrong} of {len(returns)} returns of {name} are NaN or infinite"
                )
            if np.abs(returns).max() > _LARGEST:
                return f"returns of {name} are too large to be added up"
        return None

    def differences(self) -> FloatArray:
        """Return B - A for each seed and number that both have completed."""
        of_a, of_b = _by_unit(self.a), _by_unit(self.b)
        return np.array([of_b[unit] - of_a[unit] for unit in of_a if unit in of_b])


def _by_unit(columns: ResultColumns) -> dict[tuple[int, int], float]:
    done = ~columns.failed
    units = zip(
        columns.seed[done].tolist(), columns.episode[done].tolist(), strict=True
    )
    return dict(zip(units, columns.total_reward[done].tolist(), strict=True))


def _compared_task(
    task: str,
    pair: _Pair,
    found: intervals.ImprovementIntervals,
    bootstrap: Bootstrap,
) -> TaskComparison:
    counts = {"a": len(pair.returns_a), "b": len(pair.returns_b)}
    compared = TaskComparison(
        task=task,
        episodes_a=counts["a"],
        episodes_b=counts["b"],
        failed_a=len(pair.a.failures),
        failed_b=len(pair.b.failures),
        unknown=pair.unknown,
    )
    if pair.unknown is not None:
        return compared
    mean_a, mean_b = float(pair.returns_a.mean()), float(pair.returns_b.mean())
    return dataclasses.replace(
        compared,
        mean_a=mean_a,
        mean_b=mean_b,
        difference=mean_b - mean_a,
        difference_interval=found.differences.get(task),
        probability=statistics.probability_of_improvement(
            pair.returns_b, pair.returns_a
        ),
        probability_interval=found.probabilities.get(task),
        interval_method=intervals.interval_method(counts),
    )


def _with_p_values(comparison: Comparison, p_values: Mapping[str, float]) -> Comparison:
    adjusted = holm_adjusted(p_values)
    tasks = tuple(
        dataclasses.replace(
            each,
            p_value=p_values.get(each.task),
            p_value_holm=adjusted.get(each.task),
        )
        for each in comparison.tasks
    )
    return dataclasses.replace(comparison, tasks=tasks)


def _with_pairs(
    comparison: Comparison, known: Mapping[str, _Pair], bootstrap: Bootstrap
) -> Comparison:
    paired = {
        task: _paired(task, pair.differences(), bootstrap)
        for task, pair in known.items()
    }
    tasks = tuple(
        dataclasses.replace(each, paired=paired.get(each.task))
        for each in comparison.tasks
    )
    return dataclasses.replace(comparison, tasks=tasks)


def _paired(
    task: str, differences: FloatArray, bootstrap: Bootstrap
) -> PairedDifference | None:
    if not len(differences):
        return None
    return PairedDifference(
        len(differences),
        float(differences.mean()),
        intervals.mean_interval(
            differences, stratum=f"paired:{task}", bootstrap=bootstrap
        ),
    )


def _begin_alike(a: ReadResults, b: ReadResults) -> bool:
    """Tell whether an episode of the same seed and number began in the same state."""
    return (
        a.plan.protocol == b.plan.protocol == SEEDED
        and a.plan.env_kwargs == b.plan.env_kwargs
    )


def _mann_whitney(
    a: Mapping[str, FloatArray], b: Mapping[str, FloatArray]
) -> dict[str, float]:
    """Return the two-sided p-value of the Mann-Whitney test of each task.

    H. B. Mann and D. R. Whitney, Annals of Mathematical Statistics 18 (1947). Exact
    for small samples without ties, else by the normal approximation with corrections
    for ties and continuity, as scipy chooses. Where all returns are equal it is 1.
    """
    if not a:
        return {}
    try:
        # Here, because it takes longer to import than all else, and is optional.
        from scipy.stats import mannwhitneyu  # type: ignore[import-untyped] # no stubs
    except ImportError as error:
        raise MissingDependency(
            "scipy",
            purpose="Comparing evaluations",
            install='pip install "mjrec[evaluation]"',
        ) from error
    return {
        task: 1.0
        if np.ptp(np.concatenate([a[task], b[task]])) == 0
        else float(mannwhitneyu(b[task], a[task], alternative="two-sided").pvalue)
        for task in a
    }


def _compared_scores(
    a: ReadResults, b: ReadResults, known: Mapping[str, _Pair], bootstrap: Bootstrap
) -> ScoreComparison | None:
    ranges_a, ranges_b = _score_ranges(a), _score_ranges(b)
    scores_a: dict[str, FloatArray] = {}
    scores_b: dict[str, FloatArray] = {}
    for task, pair in known.items():
        scale = ranges_a.get(task)
        if scale is not None and scale == ranges_b.get(task) and _is_usable(scale):
            scores_a[task] = scaled(pair.returns_a, scale)
            scores_b[task] = scaled(pair.returns_b, scale)
    if not scores_a:
        return None
    iqm_a = statistics.interquartile_mean_across(scores_a)
    iqm_b = statistics.interquartile_mean_across(scores_b)
    return ScoreComparison(
        tasks=tuple(scores_a),
        iqm_a=iqm_a,
        iqm_b=iqm_b,
        difference=iqm_b - iqm_a,
        interval=intervals.iqm_difference_interval(
            scores_b, scores_a, bootstrap=bootstrap
        ),
    )


def _is_usable(scale: tuple[float, float]) -> bool:
    """Tell whether a range, which comes from a file, leaves returns finite."""
    low, high = scale
    return 1 / _LARGEST < high - low < _LARGEST


def _score_ranges(results: ReadResults) -> dict[str, tuple[float, float] | None]:
    return {summary.task: summary.score_range for summary in results.summaries}


def _cautions(
    a: ReadResults, b: ReadResults, pairs: Mapping[str, _Pair]
) -> Iterator[str]:
    for name, of_a, of_b in _different(a.plan, b.plan, _CONDITIONS):
        yield (
            f"{name} was {of_a} in A and is {of_b} in B: returns under different "
            "conditions do not tell which policy is better"
        )
    for task, pair in pairs.items():
        for name, columns in (("A", pair.a), ("B", pair.b)):
            if columns.failures:
                yield (
                    f"{task}: {len(columns.failures)} of {len(columns)} episodes of "
                    f"{name} failed; the figures are of the others"
                )


def _remarks(a: ReadResults, b: ReadResults) -> Iterator[str]:
    for name, of_a, of_b in _different(a.plan, b.plan, _CHOICES):
        yield f"{name}: {of_a} in A, {of_b} in B"
    for package in sorted({*a.versions, *b.versions}):
        of_a, of_b = (each.versions.get(package, "none") for each in (a, b))
        if of_a != of_b:
            yield f"{package}: {of_a} in A, {of_b} in B"


def _different(
    a: EvaluationPlan, b: EvaluationPlan, names: Sequence[str]
) -> Iterator[tuple[str, str, str]]:
    for name in names:
        of_a, of_b = getattr(a, name), getattr(b, name)
        if of_a != of_b:
            yield name, _told(of_a), _told(of_b)


def _told(value: object) -> str:
    if value is None:
        return "the environment's own"
    if isinstance(value, tuple):
        shown = ", ".join(map(str, value[:_MOST_TOLD]))
        return f"{shown} ..." if len(value) > _MOST_TOLD else shown
    return str(value)

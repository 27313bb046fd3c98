# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals of figures of returns and scores.

Two methods, by the number of episodes that a figure is of:

- Up to `MOST_RESAMPLED`: the percentile bootstrap. Each resample draws, from every
  task's episodes, as many as there are, with replacement; the figure of each resample
  is taken; the interval is between two quantiles of these figures (B. Efron, Annals of
  Statistics 7, 1979; stratified by task as in Agarwal et al., arXiv 2108.13264).
- Above: the large-sample interval, figure +- z standard errors. Resampling would cost
  a thousand times as much and give the same digits. The standard error is that of the
  figure's linearisation: of a mean the usual one; of the interquartile mean that of
  Tukey and McLaughlin (winsorised variance, Sankhya A 25, 1963); of the probability of
  improvement that of DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988).

The unit is the episode, and the strata are the tasks. What is drawn from a task
depends on the seed, the task's name and its number of episodes only: not on the other
tasks, nor their order, nor the version of NumPy (raw output of PCG64, which NumPy
keeps as it is, unlike what its Generator makes of it).

An interval from a single episode of a task is none: it would have no width.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from .statistics import (
    FloatArray,
    Samples,
    interquartile_bounds,
    interquartile_mean,
    interquartile_mean_across,
    mean_probability_of_improvement,
    normal_quantile,
    optimality_gap,
    performance_profile,
    placements,
    probability_of_improvement,
)
from .summaries import Bootstrap, Interval

MOST_RESAMPLED: Final = 3000
"""Of how many episodes, of all strata together, figures are bootstrapped."""

PERCENTILE_BOOTSTRAP: Final = "percentile bootstrap"
LARGE_SAMPLE: Final = "large-sample normal interval"

# Of a block of resamples; 8 MB of float64.
_BLOCK: Final = 1 << 20

_Positions: TypeAlias = npt.NDArray[np.int32]
_Counts: TypeAlias = npt.NDArray[np.intp]


@dataclass(frozen=True)
class TaskIntervals:
    """Intervals of figures of one task's returns.

    Attributes:
        mean: of the mean.
        iqm: of the interquartile mean.
    """

    mean: Interval
    iqm: Interval


@dataclass(frozen=True)
class AcrossIntervals:
    """Intervals of figures of several tasks' scores.

    Attributes:
        iqm: of the interquartile mean of all scores.
        optimality_gap: of that.
        profile_low: of the performance profile at each threshold.
        profile_high: likewise.
    """

    iqm: Interval
    optimality_gap: Interval
    profile_low: FloatArray
    profile_high: FloatArray


@dataclass(frozen=True)
class ImprovementIntervals:
    """Intervals of what one sample of each task has more than another.

    Attributes:
        differences: of the differences of means, for each task that has one.
        probabilities: of the probabilities of improvement, likewise.
        mean_probability: of their mean over all tasks; None where a task has none.
    """

    differences: Mapping[str, Interval]
    probabilities: Mapping[str, Interval]
    mean_probability: Interval | None


def interval_method(counts: Mapping[str, int]) -> str | None:
    """Return which method intervals are made with; None where there can be none.

    Args:
        counts: the number of episodes of each task.
    """
    if not counts or min(counts.values()) < 2:
        return None
    is_small = sum(counts.values()) <= MOST_RESAMPLED
    return PERCENTILE_BOOTSTRAP if is_small else LARGE_SAMPLE


def mean_interval(
    values: FloatArray, *, stratum: str, bootstrap: Bootstrap
) -> Interval | None:
    """Return the interval of the mean of one sample.

    Args:
        values: of the sample.
        stratum: chooses the generator's stream, with the seed.
        bootstrap: how.
    """
    match interval_method({stratum: len(values)}):
        case None:
            return None
        case method if method == LARGE_SAMPLE:
            return _normal(values.mean(), _error_of_mean(values), bootstrap)
    ordered = np.sort(values)
    means = [
        ordered[positions[stratum]].mean(axis=1)
        for positions in _resamples({stratum: len(values)}, bootstrap)
    ]
    return _percentiles(np.concatenate(means), bootstrap)


def task_intervals(
    values: FloatArray, *, task: str, bootstrap: Bootstrap
) -> TaskIntervals | None:
    """Return the intervals of mean and interquartile mean of one task's returns."""
    method = interval_method({task: len(values)})
    if method is None:
        return None
    if method == LARGE_SAMPLE:
        samples = {task: values}
        return TaskIntervals(
            _normal(values.mean(), _error_of_mean(values), bootstrap),
            _normal(interquartile_mean(values), _error_of_iqm(samples), bootstrap),
        )
    ordered = np.sort(values)
    first, end = interquartile_bounds(len(values))
    means, iqms = [], []
    for block in _resamples({task: len(values)}, bootstrap):
        positions = block[task]
        means.append(ordered[positions].mean(axis=1))
        positions.sort(axis=1)
        iqms.append(ordered[positions[:, first:end]].mean(axis=1))
    return TaskIntervals(
        _percentiles(np.concatenate(means), bootstrap),
        _percentiles(np.concatenate(iqms), bootstrap),
    )


def across_intervals(
    scores: Samples, *, thresholds: FloatArray, bootstrap: Bootstrap
) -> AcrossIntervals | None:
    """Return the intervals of what is said of several tasks' scores."""
    match interval_method(_counts(scores)):
        case None:
            return None
        case method if method == LARGE_SAMPLE:
            return _across_by_normal(scores, thresholds, bootstrap)
    return _across_by_bootstrap(scores, thresholds, bootstrap)


def improvement_intervals(
    x: Samples, y: Samples, *, bootstrap: Bootstrap
) -> ImprovementIntervals:
    """Return the intervals of what `x` has more than `y`, task by task.

    The two samples of a task are resampled independently of each other. A task with
    a single episode on either side has no interval; then there is none of the mean
    over tasks either.
    """
    differences: dict[str, Interval] = {}
    chances: dict[str, Interval] = {}
    resampled: list[FloatArray] = []
    errors: list[float] = []
    for task in x:
        match interval_method({"x": len(x[task]), "y": len(y[task])}):
            case None:
                continue
            case method if method == LARGE_SAMPLE:
                error = _error_of_difference(x[task], y[task])
                difference = x[task].mean() - y[task].mean()
                differences[task] = _normal(difference, error, bootstrap)
                error = _error_of_probability(x[task], y[task])
                chance = probability_of_improvement(x[task], y[task])
                chances[task] = _clipped(_normal(chance, error, bootstrap))
            case _:
                drawn_differences, drawn_chances = _resampled_improvement(
                    x[task], y[task], task=task, bootstrap=bootstrap
                )
                differences[task] = _percentiles(drawn_differences, bootstrap)
                chances[task] = _percentiles(drawn_chances, bootstrap)
                resampled.append(drawn_chances)
                error = _error_of_probability(x[task], y[task])
        errors.append(error)
    overall = None
    if x and len(resampled) == len(x):
        overall = _percentiles(np.mean(resampled, axis=0), bootstrap)
    elif x and len(errors) == len(x):
        chance = mean_probability_of_improvement(x, y)
        error = math.hypot(*errors) / len(errors)
        overall = _clipped(_normal(chance, error, bootstrap))
    return ImprovementIntervals(differences, chances, overall)


def iqm_difference_interval(
    x: Samples, y: Samples, *, bootstrap: Bootstrap
) -> Interval | None:
    """Return the interval of iqm(x) - iqm(y), each of all its tasks' scores.

    Both are resampled by task, independently of each other.
    """
    match interval_method(_sides(x, y)):
        case None:
            return None
        case method if method == LARGE_SAMPLE:
            difference = interquartile_mean_across(x) - interquartile_mean_across(y)
            error = math.hypot(_error_of_iqm(x), _error_of_iqm(y))
            return _normal(difference, error, bootstrap)
    differences = [
        _resampled_iqm(x, "x", block) - _resampled_iqm(y, "y", block)
        for block in _resamples(_sides(x, y), bootstrap)
    ]
    return _percentiles(np.concatenate(differences), bootstrap)


def _sides(x: Samples, y: Samples) -> dict[str, int]:
    """Return the sizes of the strata of two samples of each task."""
    return {
        f"{side}:{task}": len(values)
        for side, samples in (("x", x), ("y", y))
        for task, values in samples.items()
    }


def _resampled_iqm(
    samples: Samples, side: str, block: Mapping[str, _Positions]
) -> FloatArray:
    drawn = [np.sort(samples[task])[block[f"{side}:{task}"]] for task in samples]
    pooled = np.concatenate(drawn, axis=1)
    pooled.sort(axis=1)
    first, end = interquartile_bounds(pooled.shape[1])
    means: FloatArray = pooled[:, first:end].mean(axis=1)
    return means


def _resampled_improvement(
    x: FloatArray, y: FloatArray, *, task: str, bootstrap: Bootstrap
) -> tuple[FloatArray, FloatArray]:
    """Return difference of means and probability of improvement of each resample."""
    # So that nothing depends on the order in which episodes are given.
    x, y = np.sort(x), np.sort(y)
    distinct, codes = np.unique(np.concatenate([x, y]), return_inverse=True)
    codes_of = {"x": codes[: len(x)], "y": codes[len(x) :]}
    differences, chances = [], []
    for block in _resamples(_sides({task: x}, {task: y}), bootstrap):
        drawn_x, drawn_y = block[f"x:{task}"], block[f"y:{task}"]
        differences.append(x[drawn_x].mean(axis=1) - y[drawn_y].mean(axis=1))
        counts_x = _row_counts(codes_of["x"][drawn_x], len(distinct))
        counts_y = _row_counts(codes_of["y"][drawn_y], len(distinct))
        # Twice the pairs of each value of x with what is below it, and once those with
        # what equals it.
        doubled = (counts_x * (2 * counts_y.cumsum(axis=1) - counts_y)).sum(axis=1)
        chances.append(doubled / (2 * len(x) * len(y)))
    return np.concatenate(differences), np.concatenate(chances)


def _row_counts(codes: _Counts, kinds: int) -> _Counts:
    """Return how often each of the codes below `kinds` stands in each row."""
    rows = len(codes)
    cells = codes + np.arange(rows)[:, None] * kinds
    return np.bincount(cells.ravel(), minlength=rows * kinds).reshape(rows, kinds)


def _counts(samples: Samples) -> dict[str, int]:
    return {task: len(values) for task, values in samples.items()}


def _across_by_bootstrap(
    scores: Samples, thresholds: FloatArray, bootstrap: Bootstrap
) -> AcrossIntervals:
    pooled = np.sort(np.concatenate(list(scores.values())))
    # Where a task's own sorted values stand among all of them.
    ordered = {task: np.sort(values) for task, values in scores.items()}
    places = {
        task: np.searchsorted(pooled, values).astype(np.int32)
        for task, values in ordered.items()
    }
    shortfalls = {task: 1 - np.minimum(values, 1) for task, values in ordered.items()}
    first, end = interquartile_bounds(len(pooled))
    iqms, gaps, profiles = [], [], []
    for block in _resamples(_counts(scores), bootstrap):
        drawn = np.concatenate([places[task][block[task]] for task in scores], axis=1)
        drawn.sort(axis=1)
        iqms.append(pooled[drawn[:, first:end]].mean(axis=1))
        gaps.append(_mean([shortfalls[t][block[t]].mean(axis=1) for t in scores]))
        profiles.append(
            _mean(_shares_above(ordered[t], block[t], thresholds) for t in scores)
        )
    low, high = np.quantile(np.concatenate(profiles), _tails(bootstrap), axis=0)
    return AcrossIntervals(
        _percentiles(np.concatenate(iqms), bootstrap),
        _percentiles(np.concatenate(gaps), bootstrap),
        low,
        high,
    )


def _mean(arrays: Iterable[FloatArray]) -> FloatArray:
    """Return the mean of arrays of one shape, of which one is held at a time."""
    total, count = None, 0
    for array in arrays:
        total = array if total is None else np.add(total, array, out=total)
        count += 1
    assert total is not None
    return total / count


def _shares_above(
    ordered: FloatArray, positions: _Positions, thresholds: FloatArray
) -> FloatArray:
    """Return for each resample and threshold the share of what was drawn above it."""
    # A value in bin b is above the first b thresholds.
    bin_of = np.searchsorted(thresholds, ordered, side="left")
    counts = _row_counts(bin_of[positions], len(thresholds) + 1)
    above = counts[:, ::-1].cumsum(axis=1)[:, ::-1]
    shares: FloatArray = above[:, 1:] / positions.shape[1]
    return shares


def _across_by_normal(
    scores: Samples, thresholds: FloatArray, bootstrap: Bootstrap
) -> AcrossIntervals:
    tasks = len(scores)
    gap_errors = [_error_of_mean(np.minimum(v, 1)) for v in scores.values()]
    variances = np.zeros(len(thresholds))
    for task, values in scores.items():
        share = performance_profile({task: values}, thresholds)
        variances += share * (1 - share) / (len(values) - 1)
    reach = normal_quantile(bootstrap.confidence) * np.sqrt(variances) / tasks
    shares = performance_profile(scores, thresholds)
    return AcrossIntervals(
        _normal(interquartile_mean_across(scores), _error_of_iqm(scores), bootstrap),
        _normal(optimality_gap(scores), math.hypot(*gap_errors) / tasks, bootstrap),
        np.maximum(0, shares - reach),
        np.minimum(1, shares + reach),
    )


def _error_of_mean(values: FloatArray) -> float:
    return float(np.std(values, ddof=1) / math.sqrt(len(values)))


def _error_of_difference(x: FloatArray, y: FloatArray) -> float:
    return math.hypot(_error_of_mean(x), _error_of_mean(y))


def _error_of_probability(x: FloatArray, y: FloatArray) -> float:
    return _error_of_difference(placements(x, y), placements(y, x))


def _error_of_iqm(samples: Samples) -> float:
    """Return the standard error of the interquartile mean of all samples as one.

    Each value moves it by its winsorised self, divided by how many are averaged; only
    what varies inside a stratum varies.
    """
    pooled = np.sort(np.concatenate(list(samples.values())))
    first, end = interquartile_bounds(len(pooled))
    low, high = pooled[first], pooled[end - 1]
    variance = sum(
        len(values) * np.var(np.clip(values, low, high), ddof=1)
        for values in samples.values()
    )
    return math.sqrt(variance) / (end - first)


def _resamples(
    counts: Mapping[str, int], bootstrap: Bootstrap
) -> Iterator[dict[str, _Positions]]:
    """Yield blocks of resamples: of each stratum the positions drawn from it.

    A block has for each stratum an array of the shape (rows, count); the rows of all
    blocks are the resamples. How they are cut into blocks changes nothing.
    """
    streams = {name: _stream(name, bootstrap.seed) for name in counts}
    block = max(1, _BLOCK // sum(counts.values()))
    for begin in range(0, bootstrap.resamples, block):
        rows = min(block, bootstrap.resamples - begin)
        yield {
            name: _drawn(streams[name], rows, count) for name, count in counts.items()
        }


def _stream(name: str, seed: int) -> np.random.PCG64:
    digest = hashlib.sha256(name.encode()).digest()
    key = int.from_bytes(digest[:8], "big")
    return np.random.PCG64(np.random.SeedSequence([seed, key]))


def _drawn(stream: np.random.PCG64, rows: int, count: int) -> _Positions:
    """Return positions below `count`, all equally likely to 1 part in 2^32 / count."""
    raw = np.asarray(stream.random_raw(rows * count))
    raw >>= np.uint64(32)
    raw *= np.uint64(count)
    raw >>= np.uint64(32)
    # Half as wide as it came: sorting these is what takes the time.
    return raw.astype(np.int32).reshape(rows, count)


def _tails(bootstrap: Bootstrap) -> tuple[float, float]:
    outside = (1 - bootstrap.confidence) / 2
    return outside, 1 - outside


def _percentiles(figures: FloatArray, bootstrap: Bootstrap) -> Interval:
    low, high = np.quantile(figures, _tails(bootstrap))
    return Interval(float(low), float(high))


def _clipped(interval: Interval) -> Interval:
    return Interval(max(0.0, interval.low), min(1.0, interval.high))


def _normal(figure: float, error: float, bootstrap: Bootstrap) -> Interval:
    reach = normal_quantile(bootstrap.confidence) * error
    return Interval(float(figure - reach), float(figure + reach))

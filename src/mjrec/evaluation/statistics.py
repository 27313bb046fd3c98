# SPDX-License-Identifier: Apache-2.0
"""Statistical figures for returns and scores, with confidence intervals.

Every figure is defined once, as a function that reduces the last axis of its samples.
SciPy's bootstrap can therefore evaluate thousands of resamples together.
`docs/reference/statistics.md` lists the formulas and their sources. The tests compare
the figures with rliable and with values computed by hand.

All numbers must be finite. `summaries` and `comparing` handle NaN and infinity.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import InvalidArgument

FloatArray: TypeAlias = npt.NDArray[np.float64]

PERCENTILE_BOOTSTRAP: Final = "percentile bootstrap"
LARGE_SAMPLE: Final = "large-sample normal interval"

MOST_RESAMPLED: Final = 3000
"""Maximum total number of values in the samples for which the bootstrap is used."""

_MOST_RESAMPLES: Final = 1_000_000

# Number of values in a block of resamples. A block takes 2 MB, to fit in a CPU cache.
_BLOCK: Final = 1 << 18


@dataclass(frozen=True)
class Interval:
    """A confidence interval.

    Attributes:
        low: the lower end.
        high: the upper end.
    """

    low: float
    high: float


@dataclass(frozen=True)
class Estimate:
    """A figure with its confidence interval.

    Attributes:
        value: the figure.
        interval: the confidence interval, or None if it cannot be computed.
        interval_method: name of the method for the interval; None without an interval.
    """

    value: float
    interval: Interval | None = None
    interval_method: str | None = None


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """Settings for bootstrap confidence intervals.

    Attributes:
        resamples: number of resamples.
        seed: seed for the random number generator.
        confidence: confidence level.

    Raises:
        InvalidArgument: a value is out of range.
    """

    resamples: int = 10_000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not 1 <= self.resamples <= _MOST_RESAMPLES:
            raise InvalidArgument(
                f"resamples must be from 1 to {_MOST_RESAMPLES} (10000 is usual), but "
                f"it is {self.resamples}."
            )
        if not 0 < self.confidence < 1:
            raise InvalidArgument(
                "confidence must be between 0 and 1 (0.95 is usual), but it is "
                f"{self.confidence}."
            )
        if not 0 <= self.seed < 2**64:
            raise InvalidArgument(
                "seed must be a whole number from 0 to 2^64 - 1, but it is "
                f"{self.seed}."
            )


@dataclass(frozen=True)
class Figure:
    """A figure that is computed from one or more samples.

    Attributes:
        samples: the samples. Each is resampled independently along its last axis.
        of: function that computes the figure from samples. It returns an array of shape
            `(...)`, or of shape `(k, ...)` if the figure consists of k numbers.
        error: function that returns the standard error of the figure, which is valid
            for large samples.
    """

    samples: tuple[npt.NDArray[Any], ...]
    of: Callable[[Sequence[FloatArray]], FloatArray]
    error: Callable[[], FloatArray]

    @property
    def values(self) -> FloatArray:
        """The figure as an array."""
        return np.asarray(self.of(self.samples))

    @property
    def value(self) -> float:
        """The figure as a number, if it consists of a single number."""
        return float(self.values)

    @property
    def interval_method(self) -> str | None:
        """Name of the method for intervals; None if a sample has only one value.

        In that case, the interval would have zero width and suggest certainty.
        """
        sizes = [len(sample) for sample in self.samples]
        if min(sizes) < 2:
            return None
        return PERCENTILE_BOOTSTRAP if sum(sizes) <= MOST_RESAMPLED else LARGE_SAMPLE

    def ends(self, how: Bootstrap) -> tuple[FloatArray, FloatArray] | None:
        """Return the lower and upper ends of the intervals; None without intervals."""
        if self.interval_method is None:
            return None
        if self.interval_method == LARGE_SAMPLE:
            reach = NormalDist().inv_cdf(0.5 + how.confidence / 2) * self.error()
            return self.values - reach, self.values + reach
        found = _stats().bootstrap(
            self.samples,
            lambda *samples, axis: self.of(samples),
            vectorized=True,
            method="percentile",
            n_resamples=how.resamples,
            batch=max(1, _BLOCK // sum(map(len, self.samples))),
            confidence_level=how.confidence,
            rng=np.random.default_rng(how.seed),
        )
        return found.confidence_interval.low, found.confidence_interval.high

    def interval(self, how: Bootstrap) -> Interval | None:
        """Return the interval of a figure that consists of a single number."""
        ends = self.ends(how)
        return None if ends is None else Interval(*map(float, ends))

    def estimate(self, how: Bootstrap) -> Estimate:
        """Return a figure that consists of a single number, with its interval."""
        return Estimate(self.value, self.interval(how), self.interval_method)

    def __sub__(self, other: Figure) -> Figure:
        """Return the difference between two figures with independent samples."""
        split = len(self.samples)
        return Figure(
            self.samples + other.samples,
            lambda samples: self.of(samples[:split]) - other.of(samples[split:]),
            lambda: np.hypot(self.error(), other.error()),
        )


def average(figures: Iterable[Figure]) -> Figure:
    """Return the mean of several figures, all with the same weight.

    The samples of the figures must be independent, such as those of different tasks.
    """
    parts = list(figures)

    def of(samples: Sequence[FloatArray]) -> FloatArray:
        rest = iter(samples)
        total = sum(part.of([next(rest) for _ in part.samples]) for part in parts)
        return np.asarray(total / len(parts))

    def error() -> FloatArray:
        variance = sum(part.error() ** 2 for part in parts)
        return np.sqrt(variance) / len(parts)

    return Figure(tuple(s for part in parts for s in part.samples), of, error)


def mean(sample: FloatArray) -> Figure:
    """Return the mean of a sample."""
    return Figure(
        # Sorted, so that the result does not depend on the order of episodes.
        (np.sort(sample),),
        lambda samples: samples[0].mean(axis=-1),
        lambda: _stats().sem(sample),
    )


def interquartile_mean(samples: Iterable[FloatArray]) -> Figure:
    """Return the mean of the middle half of the pooled samples.

    Of all n values, the floor(n / 4) smallest and the floor(n / 4) largest are left
    out. Larger samples have more weight.
    """
    strata = tuple(np.sort(sample) for sample in samples)

    def of(samples: Sequence[FloatArray]) -> FloatArray:
        pooled = np.concatenate(samples, axis=-1)
        return np.asarray(_stats().trim_mean(pooled, 0.25, axis=-1))

    def error() -> FloatArray:
        # The variance of the winsorized values within each stratum.
        values = np.sort(np.concatenate(strata))
        first = len(values) // 4
        low, high = values[first], values[-1 - first]
        variance = sum(len(s) * np.var(np.clip(s, low, high), ddof=1) for s in strata)
        return np.asarray(np.sqrt(variance) / (len(values) - 2 * first))

    return Figure(strata, of, error)


def optimality_gap(scores: Iterable[FloatArray]) -> Figure:
    """Return the amount by which scores fall short of 1, averaged over tasks.

    Scores above 1 count as 1.
    """
    return average(mean(1 - np.minimum(values, 1)) for values in scores)


def performance_profile(scores: Iterable[FloatArray], thresholds: FloatArray) -> Figure:
    """Return the share of scores above each threshold, averaged over tasks.

    Args:
        scores: the scores of each task.
        thresholds: the thresholds, in ascending order.
    """
    # Only the number of thresholds below a score matters.
    return average(
        _shares_above(np.searchsorted(thresholds, values), len(thresholds))
        for values in scores
    )


def _shares_above(places: npt.NDArray[np.int64], count: int) -> Figure:
    size = len(places)

    def of(samples: Sequence[npt.NDArray[Any]]) -> FloatArray:
        rows = np.atleast_2d(samples[0])
        cells = rows + (count + 1) * np.arange(len(rows))[:, None]
        counts = np.bincount(cells.ravel(), minlength=len(rows) * (count + 1))
        up_to = counts.reshape(len(rows), -1).cumsum(axis=1)[:, :-1]
        return (1 - up_to.T / size).reshape(count, *samples[0].shape[:-1])

    def error() -> FloatArray:
        share = of([places])
        return np.sqrt(share * (1 - share) / (size - 1))

    return Figure((places,), of, error)


def improvement(x: FloatArray, y: FloatArray) -> Figure:
    """Return the probability that a value of `x` is greater than a value of `y`.

    This is #{(i, j) : x_i > y_j} / (n_x n_y), where each tie counts as one half. It
    equals the Mann-Whitney statistic U of `x` divided by the number of pairs.
    """

    def of(samples: Sequence[FloatArray]) -> FloatArray:
        size, others = (each.shape[-1] for each in samples)
        ranks = _stats().rankdata(np.concatenate(samples, axis=-1), axis=-1)
        # Ranks are multiples of 1/2, so a result of 1/2 has no rounding error.
        above = ranks[..., :size].sum(axis=-1) - size * (size + 1) / 2
        return np.asarray(above / (size * others))

    def error() -> FloatArray:
        return np.hypot(
            mean(_placements(x, y)).error(), mean(_placements(y, x)).error()
        )

    return Figure((np.sort(x), np.sort(y)), of, error)


def _placements(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the share of `y` below each value in `x`. Ties count as one half."""
    y = np.sort(y)
    below, up_to = (np.searchsorted(y, x, side=side) for side in ("left", "right"))
    return np.asarray((below + up_to) / (2 * len(y)))


def wilson_interval(successes: int, n: int, confidence: float) -> Interval:
    """Return Wilson's score interval for a share, without continuity correction."""
    found = _stats().binomtest(successes, n).proportion_ci(confidence, method="wilson")
    return Interval(float(found.low), float(found.high))


def two_sided_p_value(x: FloatArray, y: FloatArray) -> float:
    """Return the p-value of the two-sided Mann-Whitney test.

    The p-value is exact for small samples without ties.
    """
    if np.ptp(np.concatenate([x, y])) == 0:
        # SciPy would divide zero by zero.
        return 1.0
    return float(_stats().mannwhitneyu(y, x, alternative="two-sided").pvalue)


def load_scipy() -> None:
    """Start a thread that loads SciPy, which takes a second, while workers run."""

    def load() -> None:
        # If SciPy is missing, the code that uses it will report the error.
        with contextlib.suppress(ImportError):
            _stats()

    # Not a daemon thread, because the interpreter must not exit while C++ modules load.
    threading.Thread(target=load, name="mjrec-scipy").start()


def _stats() -> Any:
    # Imported here because SciPy takes longer to import than everything else.
    return importlib.import_module("scipy.stats")

# SPDX-License-Identifier: Apache-2.0
"""The figures that are said of returns and scores, and their confidence intervals.

A *resample* draws from each sample as many values as there are, with replacement: it
says how often each one was drawn. Every figure is written down once, as a function of
such counts. The figure itself is that of counts that are all 1, and its bootstrap
interval comes from those of thousands of resamples. `docs/statistics.md` has the
formulas and their sources; the tests compare them with SciPy, rliable, and figures by
hand.

All of it takes finite numbers: `summaries` and `comparing` decide what becomes of
others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import InvalidArgument

FloatArray: TypeAlias = npt.NDArray[np.float64]
Counts: TypeAlias = npt.NDArray[np.int64]

PERCENTILE_BOOTSTRAP: Final = "percentile bootstrap"
LARGE_SAMPLE: Final = "large-sample normal interval"

MOST_RESAMPLED: Final = 3000
"""Of how many values, of all samples together, figures are bootstrapped."""

_MOST_RESAMPLES: Final = 1_000_000

# The values of a block of resamples: 2 MB of counts stay in a CPU's cache.
_BLOCK: Final = 1 << 18


@dataclass(frozen=True)
class Interval:
    """A confidence interval.

    Attributes:
        low: its lower end.
        high: its upper end.
    """

    low: float
    high: float


@dataclass(frozen=True)
class Estimate:
    """A figure, and how far it could be off.

    Attributes:
        value: the figure.
        interval: of that; None where there is none.
        interval_method: how it was made; None likewise.
    """

    value: float
    interval: Interval | None = None
    interval_method: str | None = None


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """How confidence intervals are made.

    Attributes:
        resamples: how many.
        seed: of the generator that draws them.
        confidence: the share of the intervals that hold the true value.

    Raises:
        InvalidArgument: there are no such intervals.
    """

    resamples: int = 10_000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not 1 <= self.resamples <= _MOST_RESAMPLES:
            raise InvalidArgument(
                f"Intervals are made from 1 to {_MOST_RESAMPLES} resamples (10000 is "
                f"usual), got {self.resamples}."
            )
        if not 0 < self.confidence < 1:
            raise InvalidArgument(
                "The confidence of an interval lies between 0 and 1 (0.95 is usual), "
                f"got {self.confidence}."
            )
        if not 0 <= self.seed < 2**64:
            raise InvalidArgument(
                f"A seed is a whole number from 0 to 2^64 - 1, got {self.seed}."
            )


@dataclass(frozen=True)
class Figure:
    """A figure of one sample or several.

    Attributes:
        sizes: of the samples, which are drawn from independently of each other.
        of: returns the figure of each resample, `(rows,)` or, of a figure that is many
            numbers, `(rows, k)`. It takes the counts of each sample's values,
            `(rows, size)`.
        error: returns the standard error of the figure, where the samples are large.
    """

    sizes: tuple[int, ...]
    of: Callable[[Sequence[Counts]], FloatArray]
    error: Callable[[], FloatArray]

    @property
    def values(self) -> FloatArray:
        """The figure, if it is many numbers."""
        ones = [np.ones((1, size), np.int64) for size in self.sizes]
        return np.asarray(self.of(ones)[0])

    @property
    def value(self) -> float:
        """The figure, if it is one number."""
        return float(self.values)

    @property
    def interval_method(self) -> str | None:
        """How intervals are made; None where a sample has a single value.

        An interval of no width would say that all is known.
        """
        if min(self.sizes) < 2:
            return None
        few = sum(self.sizes) <= MOST_RESAMPLED
        return PERCENTILE_BOOTSTRAP if few else LARGE_SAMPLE

    def ends(self, how: Bootstrap) -> tuple[FloatArray, FloatArray] | None:
        """Return the lower and upper ends of the intervals of a figure."""
        if self.interval_method is None:
            return None
        if self.interval_method == LARGE_SAMPLE:
            reach = _normal_quantile(how.confidence) * self.error()
            return self.values - reach, self.values + reach
        figures = np.concatenate([self.of(c) for c in _resamples(self.sizes, how)])
        outside = (1 - how.confidence) / 2
        low, high = np.quantile(figures, (outside, 1 - outside), axis=0)
        return low, high

    def interval(self, how: Bootstrap) -> Interval | None:
        """Return the interval of a figure that is one number."""
        ends = self.ends(how)
        return None if ends is None else Interval(*map(float, ends))

    def estimate(self, how: Bootstrap) -> Estimate:
        """Return a figure that is one number, with its interval."""
        return Estimate(self.value, self.interval(how), self.interval_method)

    def __sub__(self, other: Figure) -> Figure:
        """Return the difference of the figures of independent samples."""
        split = len(self.sizes)
        return Figure(
            self.sizes + other.sizes,
            lambda counts: self.of(counts[:split]) - other.of(counts[split:]),
            lambda: np.hypot(self.error(), other.error()),
        )


def average(figures: Iterable[Figure]) -> Figure:
    """Return the mean of the figures of independent samples: of tasks, each alike."""
    parts = list(figures)

    def of(counts: Sequence[Counts]) -> FloatArray:
        total: FloatArray = np.zeros(1)
        begin = 0
        for part in parts:
            end = begin + len(part.sizes)
            total = total + part.of(counts[begin:end])
            begin = end
        return total / len(parts)

    def error() -> FloatArray:
        variance = sum(part.error() ** 2 for part in parts)
        return np.sqrt(variance) / len(parts)

    return Figure(tuple(size for part in parts for size in part.sizes), of, error)


def mean(sample: FloatArray) -> Figure:
    """Return the mean of a sample."""
    # So that it does not depend on the order in which episodes are given.
    values, size = np.sort(sample), len(sample)
    return Figure(
        (size,),
        lambda counts: _summed(counts[0] * values) / size,
        lambda: np.asarray(np.std(values, ddof=1) / math.sqrt(size)),
    )


def interquartile_mean(samples: Iterable[FloatArray]) -> Figure:
    """Return the mean of the middle half of all samples as one.

    floor(n / 4) of all n values are cut off at each end. Where samples have different
    sizes, a larger one weighs more.
    """
    strata = [np.sort(sample) for sample in samples]
    pooled = np.concatenate(strata)
    order = np.argsort(pooled, kind="stable")
    values = pooled[order]
    first = len(values) // 4
    end = len(values) - first

    def of(counts: Sequence[Counts]) -> FloatArray:
        reached = np.concatenate(counts, axis=1)[:, order].cumsum(axis=1)
        middle = np.diff(np.clip(reached, first, end), axis=1, prepend=first)
        return _summed(middle * values) / (end - first)

    def error() -> FloatArray:
        # Each value moves it by its winsorised self; what varies inside a stratum
        # varies.
        low, high = values[first], values[end - 1]
        variance = sum(len(s) * np.var(np.clip(s, low, high), ddof=1) for s in strata)
        return np.asarray(np.sqrt(variance) / (end - first))

    return Figure(tuple(map(len, strata)), of, error)


def optimality_gap(scores: Iterable[FloatArray]) -> Figure:
    """Return by how much scores fall short of 1, averaged over tasks.

    What is above 1 makes up for nothing.
    """
    return average(mean(1 - np.minimum(values, 1)) for values in scores)


def performance_profile(scores: Iterable[FloatArray], thresholds: FloatArray) -> Figure:
    """Return for each threshold the share of scores above it, averaged over tasks."""
    return average(_shares_above(values, thresholds) for values in scores)


def _shares_above(sample: FloatArray, thresholds: FloatArray) -> Figure:
    size = len(sample)
    not_above = np.searchsorted(np.sort(sample), thresholds, side="right")

    def error() -> FloatArray:
        share = not_above / size
        return np.sqrt(share * (1 - share) / (size - 1))

    return Figure(
        (size,), lambda counts: 1 - _reached(counts[0])[:, not_above] / size, error
    )


def improvement(x: FloatArray, y: FloatArray) -> Figure:
    """Return the probability that a value of `x` is above one of `y`.

    #{(i, j) : x_i > y_j} / (n_x n_y), where equal ones count half: the Mann-Whitney
    statistic U of `x`, divided by the number of pairs.
    """
    x, y = np.sort(x), np.sort(y)
    below, up_to = (np.searchsorted(y, x, side=side) for side in ("left", "right"))
    pairs = len(x) * len(y)

    def of(counts: Sequence[Counts]) -> FloatArray:
        # Whole numbers, so that it is 1/2 where it should be.
        reached = _reached(counts[1])
        doubled = counts[0] * (reached[:, below] + reached[:, up_to])
        return _summed(doubled) / (2 * pairs)

    def error() -> FloatArray:
        of_x = (below + up_to) / (2 * len(y))
        lower, upper = (np.searchsorted(x, y, side=side) for side in ("left", "right"))
        of_y = (lower + upper) / (2 * len(x))
        return np.hypot(mean(of_x).error(), mean(of_y).error())

    return Figure((len(x), len(y)), of, error)


def wilson_interval(successes: int, n: int, confidence: float) -> Interval:
    """Return Wilson's score interval, without correction for continuity, of a share.

    The values p with |k/n - p| <= z sqrt(p (1 - p) / n). Where all or none succeeded,
    one end is exactly 1 or 0.
    """
    z = _normal_quantile(confidence)
    middle = successes + z * z / 2
    reach = z * math.sqrt(successes * (n - successes) / n + z * z / 4)
    # Rounding would leave 1e-18 of them.
    return Interval(
        0.0 if successes == 0 else (middle - reach) / (n + z * z),
        1.0 if successes == n else (middle + reach) / (n + z * z),
    )


def _normal_quantile(confidence: float) -> float:
    """Return how many standard errors a two-sided interval reaches to each side."""
    return NormalDist().inv_cdf(0.5 + confidence / 2)


def _summed(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(rows.sum(axis=1))


def _reached(counts: Counts) -> Counts:
    """Return how many were drawn of the first k values, for k from 0 on."""
    return np.pad(counts.cumsum(axis=1), ((0, 0), (1, 0)))


def _resamples(sizes: Sequence[int], how: Bootstrap) -> Iterator[list[Counts]]:
    """Yield blocks of resamples: of each sample, how often each value was drawn."""
    raw = np.random.PCG64(np.random.SeedSequence(how.seed)).random_raw
    rows = max(1, _BLOCK // sum(sizes))
    for begin in range(0, how.resamples, rows):
        count = min(rows, how.resamples - begin)
        yield [
            _row_counts(_drawn(raw(count * size), size).reshape(count, size))
            for size in sizes
        ]


def _drawn(raw: npt.NDArray[np.uint64], size: int) -> Counts:
    """Return numbers below `size`, all equally likely to 1 part in 2^32 / size.

    Of raw output, which is the same with every version of NumPy.
    """
    half = np.uint64(32)
    return ((raw >> half) * np.uint64(size) >> half).astype(np.int64)


def _row_counts(drawn: Counts) -> Counts:
    """Return how often each number below the length of a row stands in it."""
    rows, size = drawn.shape
    cells = drawn + size * np.arange(rows)[:, None]
    return np.bincount(cells.ravel(), minlength=rows * size).reshape(rows, size)

# SPDX-License-Identifier: Apache-2.0
"""The figures that are said of returns and scores, and their confidence intervals.

Every figure is written down once, as a function of samples along their last axis, so
that SciPy's bootstrap can give it thousands of resamples at once.
`docs/reference/statistics.md` has the formulas and their sources; the tests compare
them with rliable, and figures by hand.

All of it takes finite numbers: `summaries` and `comparing` decide what becomes of
others.
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
"""Of how many values, of all samples together, figures are bootstrapped."""

_MOST_RESAMPLES: Final = 1_000_000

# The values of a block of resamples: 2 MB of them stay in a CPU's cache.
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
        resamples: number of resamples.
        seed: of their generator.
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
        samples: which are drawn from independently of each other, along their last
            axis.
        of: returns the figure of samples, `(...)` or, of a figure that is many numbers,
            `(k, ...)`.
        error: returns the standard error of the figure, where the samples are large.
    """

    samples: tuple[npt.NDArray[Any], ...]
    of: Callable[[Sequence[FloatArray]], FloatArray]
    error: Callable[[], FloatArray]

    @property
    def values(self) -> FloatArray:
        """The figure, if it is many numbers."""
        return np.asarray(self.of(self.samples))

    @property
    def value(self) -> float:
        """The figure, if it is one number."""
        return float(self.values)

    @property
    def interval_method(self) -> str | None:
        """How intervals are made; None where a sample has a single value.

        An interval of no width would say that all is known.
        """
        sizes = [len(sample) for sample in self.samples]
        if min(sizes) < 2:
            return None
        return PERCENTILE_BOOTSTRAP if sum(sizes) <= MOST_RESAMPLED else LARGE_SAMPLE

    def ends(self, how: Bootstrap) -> tuple[FloatArray, FloatArray] | None:
        """Return the lower and upper ends of the intervals of a figure."""
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
        """Return the interval of a figure that is one number."""
        ends = self.ends(how)
        return None if ends is None else Interval(*map(float, ends))

    def estimate(self, how: Bootstrap) -> Estimate:
        """Return a figure that is one number, with its interval."""
        return Estimate(self.value, self.interval(how), self.interval_method)

    def __sub__(self, other: Figure) -> Figure:
        """Return the difference of the figures of independent samples."""
        split = len(self.samples)
        return Figure(
            self.samples + other.samples,
            lambda samples: self.of(samples[:split]) - other.of(samples[split:]),
            lambda: np.hypot(self.error(), other.error()),
        )


def average(figures: Iterable[Figure]) -> Figure:
    """Return the mean of the figures of independent samples: of tasks, each alike."""
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
        # So that it does not depend on the order in which episodes are given.
        (np.sort(sample),),
        lambda samples: samples[0].mean(axis=-1),
        lambda: _stats().sem(sample),
    )


def interquartile_mean(samples: Iterable[FloatArray]) -> Figure:
    """Return the mean of the middle half of all samples as one.

    floor(n / 4) of all n values are cut off at each end. Where samples have different
    sizes, a larger one weighs more.
    """
    strata = tuple(np.sort(sample) for sample in samples)

    def of(samples: Sequence[FloatArray]) -> FloatArray:
        pooled = np.concatenate(samples, axis=-1)
        return np.asarray(_stats().trim_mean(pooled, 0.25, axis=-1))

    def error() -> FloatArray:
        # Each value moves it by its winsorised self; what varies inside a stratum
        # varies.
        values = np.sort(np.concatenate(strata))
        first = len(values) // 4
        low, high = values[first], values[-1 - first]
        variance = sum(len(s) * np.var(np.clip(s, low, high), ddof=1) for s in strata)
        return np.asarray(np.sqrt(variance) / (len(values) - 2 * first))

    return Figure(strata, of, error)


def optimality_gap(scores: Iterable[FloatArray]) -> Figure:
    """Return by how much scores fall short of 1, averaged over tasks.

    What is above 1 makes up for nothing.
    """
    return average(mean(1 - np.minimum(values, 1)) for values in scores)


def performance_profile(scores: Iterable[FloatArray], thresholds: FloatArray) -> Figure:
    """Return for each threshold the share of scores above it, averaged over tasks.

    Args:
        scores: of each task.
        thresholds: rising.
    """
    # How many thresholds each score is above says all that is needed of it.
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
    """Return the probability that a value of `x` is above one of `y`.

    #{(i, j) : x_i > y_j} / (n_x n_y), where equal ones count half: the Mann-Whitney
    statistic U of `x`, divided by the number of pairs.
    """

    def of(samples: Sequence[FloatArray]) -> FloatArray:
        size, others = (each.shape[-1] for each in samples)
        ranks = _stats().rankdata(np.concatenate(samples, axis=-1), axis=-1)
        # Ranks are whole or half, so that it is 1/2 where it should be.
        above = ranks[..., :size].sum(axis=-1) - size * (size + 1) / 2
        return np.asarray(above / (size * others))

    def error() -> FloatArray:
        return np.hypot(
            mean(_placements(x, y)).error(), mean(_placements(y, x)).error()
        )

    return Figure((np.sort(x), np.sort(y)), of, error)


def _placements(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return for each value of `x` which share of `y` is below it."""
    y = np.sort(y)
    below, up_to = (np.searchsorted(y, x, side=side) for side in ("left", "right"))
    return np.asarray((below + up_to) / (2 * len(y)))


def wilson_interval(successes: int, n: int, confidence: float) -> Interval:
    """Return Wilson's score interval, without correction for continuity, of a share."""
    found = _stats().binomtest(successes, n).proportion_ci(confidence, method="wilson")
    return Interval(float(found.low), float(found.high))


def two_sided_p_value(x: FloatArray, y: FloatArray) -> float:
    """Return that of the Mann-Whitney test, exact for small samples without ties."""
    if np.ptp(np.concatenate([x, y])) == 0:
        # SciPy would divide zero by zero.
        return 1.0
    return float(_stats().mannwhitneyu(y, x, alternative="two-sided").pvalue)


def load_scipy() -> None:
    """Load SciPy on a thread: it takes a second, in which workers do their jobs."""

    def load() -> None:
        # Who needs it says what is missing.
        with contextlib.suppress(ImportError):
            _stats()

    # No daemon: the interpreter must not end in the midst of loading C++ modules.
    threading.Thread(target=load, name="mjrec-scipy").start()


def _stats() -> Any:
    # Not at the top, because it takes longer to import than all else.
    return importlib.import_module("scipy.stats")

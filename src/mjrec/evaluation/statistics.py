# SPDX-License-Identifier: Apache-2.0
"""The figures that are said of returns and scores: formulas, and nothing else.

All of them take finite numbers; what becomes of others is decided in `summarizing`
and `comparing`. Intervals by resampling are in `intervals`. A mapping is of tasks to
their samples, and every task counts alike, however many episodes it has, except in
`interquartile_mean_across`.

Sources: "Agarwal et al." is R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville,
M. G. Bellemare, "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", NeurIPS 2021, arXiv 2108.13264.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .summaries import Interval

FloatArray: TypeAlias = npt.NDArray[np.float64]
Samples: TypeAlias = Mapping[str, FloatArray]


def standard_deviation(values: FloatArray) -> float:
    """Return the sample standard deviation, sqrt(sum((x - mean)^2) / (n - 1)).

    Raises:
        ValueError: there are fewer than two values.
    """
    if len(values) < 2:
        raise ValueError("the standard deviation of less than two values is unknown")
    return float(np.std(values, ddof=1))


def interquartile_bounds(count: int) -> tuple[int, int]:
    """Return first and end of the values that the interquartile mean is of.

    Of `count` sorted values, floor(count / 4) are cut off at each end.
    """
    cut = count // 4
    return cut, count - cut


def interquartile_mean(values: FloatArray) -> float:
    """Return the mean of the middle half: the 25 % trimmed mean.

    floor(n / 4) values are left out at each end, as `scipy.stats.trim_mean(x, 0.25)`
    does and Agarwal et al. (section 4.3) with it. Of fewer than four values none is
    left out, and it is their mean.

    Raises:
        ValueError: there is no value.
    """
    if not len(values):
        raise ValueError("no values have no mean")
    first, end = interquartile_bounds(len(values))
    return float(np.sort(values)[first:end].mean())


def interquartile_mean_across(samples: Samples) -> float:
    """Return the interquartile mean of all tasks' values as one sample.

    As Agarwal et al. do, whose tasks have equally many values each: where they have
    not, a task with more of them weighs more.
    """
    return interquartile_mean(np.concatenate(list(samples.values())))


def task_means(samples: Samples) -> FloatArray:
    """Return each task's mean, in the order of the mapping."""
    return np.array([values.mean() for values in samples.values()])


def optimality_gap(samples: Samples, gamma: float = 1.0) -> float:
    """Return by how much scores fall short of `gamma`, on average.

    The mean over tasks of gamma - mean(min(x, gamma)); Agarwal et al. (section 4.3).
    What is above `gamma` makes up for nothing.
    """
    gaps = [gamma - np.minimum(values, gamma).mean() for values in samples.values()]
    return float(np.mean(gaps))


def performance_profile(samples: Samples, thresholds: FloatArray) -> FloatArray:
    """Return for each threshold the share of scores above it, averaged over tasks.

    (1 / M) sum over tasks m of (1 / N_m) #{n : x_mn > tau}: the score distribution of
    Agarwal et al. (section 4.2). A score equal to the threshold is not above it.
    """
    shares = np.zeros(len(thresholds))
    for values in samples.values():
        not_above = np.searchsorted(np.sort(values), thresholds, side="right")
        shares += 1 - not_above / len(values)
    return shares / len(samples)


def placements(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return for each value of `x` the share of `y` below it; equal ones count half."""
    return _doubled_placements(x, y) / (2 * len(y))


def probability_of_improvement(x: FloatArray, y: FloatArray) -> float:
    """Return the probability that a value of `x` is above one of `y`.

    #{(i, j) : x_i > y_j} / (n_x n_y), where equal ones count half: the Mann-Whitney
    statistic U of `x`, divided by the number of pairs; Agarwal et al. (section 4.3).
    """
    # Whole numbers until here, so that it is 1/2 where it should be.
    return int(_doubled_placements(x, y).sum()) / (2 * len(x) * len(y))


def _doubled_placements(x: FloatArray, y: FloatArray) -> npt.NDArray[np.intp]:
    ordered = np.sort(y)
    below = np.searchsorted(ordered, x, side="left")
    return below + np.searchsorted(ordered, x, side="right")


def mean_probability_of_improvement(x: Samples, y: Samples) -> float:
    """Return the mean over tasks, which both have, of `probability_of_improvement`."""
    return float(np.mean([probability_of_improvement(x[task], y[task]) for task in x]))


def normal_quantile(confidence: float) -> float:
    """Return how many standard deviations a two-sided interval reaches to each side."""
    return NormalDist().inv_cdf(0.5 + confidence / 2)


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Return Wilson's score interval, without correction for continuity, of a share.

    The values p with |k/n - p| <= z sqrt(p (1 - p) / n), which is
    (k + z^2/2 +- z sqrt(k (n - k) / n + z^2/4)) / (n + z^2). E. B. Wilson, "Probable
    Inference, the Law of Succession, and Statistical Inference", JASA 22 (1927);
    method 3 of R. G. Newcombe, Statistics in Medicine 17 (1998). Where all or none
    succeeded, one end is exactly 1 or 0.

    Raises:
        ValueError: there is no trial, or more successes than trials.
    """
    if not 0 <= successes <= n or n == 0:
        raise ValueError(f"{successes} successes of {n} trials cannot be")
    z = normal_quantile(confidence)
    middle = successes + z * z / 2
    reach = z * math.sqrt(successes * (n - successes) / n + z * z / 4)
    low = (middle - reach) / (n + z * z)
    high = (middle + reach) / (n + z * z)
    # Rounding would leave 1e-18 of them.
    return Interval(
        0.0 if successes == 0 else max(0.0, low),
        1.0 if successes == n else min(1.0, high),
    )

# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from mjrec import InvalidArgument
from mjrec.evaluation import statistics
from mjrec.evaluation.statistics import (
    LARGE_SAMPLE,
    PERCENTILE_BOOTSTRAP,
    Bootstrap,
    Interval,
    average,
    improvement,
    interquartile_mean,
    mean,
    optimality_gap,
    performance_profile,
    wilson_interval,
)

TENTHS = np.linspace(0, 1, 11)
USUAL = Bootstrap()
QUICK = Bootstrap(resamples=500)

# Ten runs of six tasks; the expected figures below are rliable 1.2.0's.
X = [
    np.array([0.43, 0.65, 0.13, 0.56, 0.11, 0.05, 0.35, 0.49, 0.39, 0.22]),
    np.array([0.29, 0.55, 0.41, 0.67, 0.79, 0.42, 0.32, 0.22, 0.51, 0.42]),
    np.array([0.24, 0.16, 0.32, 0.55, 0.5, 0.77, 0.46, 0.46, 0.34, 0.39]),
    np.array([0.41, 0.36, 0.19, 0.23, 0.49, 0.66, 0.22, 0.33, 0.18, 0.21]),
    np.array([0.42, 0.67, 0.7, 0.36, 0.3, 0.27, 0.19, 0.59, 0.86, 0.15]),
    np.array([0.15, 0.2, 0.07, 0.44, 0.52, 0.44, 0.5, 0.57, 0.39, 0.09]),
]
Y = [
    np.array([0.36, 0.61, 0.54, 0.35, 0.61, 0.78, 0.53, 0.63, 0.62, 0.33]),
    np.array([0.44, 0.29, 0.56, 0.42, 0.15, 0.84, 0.28, 0.58, 0.42, 0.35]),
    np.array([0.24, 0.37, 0.7, 0.69, 0.42, 0.17, 0.75, 0.14, 0.41, 0.67]),
    np.array([0.19, 0.52, 0.33, 0.76, 0.42, 0.38, 0.42, 0.79, 0.5, 0.54]),
    np.array([0.5, 0.31, 0.46, 0.72, 0.51, 0.5, 0.21, 0.51, 0.31, 0.23]),
    np.array([0.74, 0.59, 0.47, 0.19, 0.72, 0.71, 0.14, 0.67, 0.66, 0.49]),
]


def array(*values):
    return np.array(values, dtype=np.float64)


def normal(count, center=500.0, *, seed=0):
    return np.random.default_rng(seed).normal(center, 100, count)


def ends(interval):
    return [interval.low, interval.high]


def test_figures_across_tasks_equal_rliables():
    assert interquartile_mean(X).value == pytest.approx(0.37966666666666665)
    assert optimality_gap(X).value == pytest.approx(0.6111666666666666)
    better = average(improvement(x, y) for x, y in zip(X, Y, strict=True))
    assert better.value == pytest.approx(0.3625)
    profile = [1, 57 / 60, 48 / 60, 39 / 60, 29 / 60, 15 / 60, 8 / 60, 3 / 60, 1 / 60]
    assert performance_profile(X, TENTHS).values == pytest.approx([*profile, 0, 0])


def test_intervals_across_tasks_equal_rliables():
    """Tolerances cover the noise of its 20,000 (profile: 5,000) resamples."""
    found = ends(interquartile_mean(X).interval(USUAL))
    assert found == pytest.approx([0.3243, 0.4340], abs=0.004)
    found = ends(optimality_gap(X).interval(USUAL))
    assert found == pytest.approx([0.5653, 0.6570], abs=0.004)
    better = average(improvement(x, y) for x, y in zip(X, Y, strict=True))
    assert ends(better.interval(USUAL)) == pytest.approx([0.2658, 0.4629], abs=0.004)
    band = performance_profile(X, TENTHS).ends(USUAL)
    low = [1.0, 0.9, 0.7, 0.533, 0.367, 0.15, 0.05, 0, 0, 0, 0]
    high = [1.0, 1.0, 0.883, 0.767, 0.6, 0.35, 0.217, 0.1, 0.05, 0, 0]
    assert band[0] == pytest.approx(low, abs=0.018)
    assert band[1] == pytest.approx(high, abs=0.018)


def test_gap_and_profile_weight_tasks_alike():
    """The interquartile mean weights episodes alike.

    A score at a threshold is not above it, and one above 1 does not lower the gap.
    """
    scores = [array(1.0, 1.0), np.zeros(98)]
    assert optimality_gap(scores).value == 0.5
    assert performance_profile(scores, array(0.5)).values == [0.5]
    assert interquartile_mean(scores).value == 0
    profile = performance_profile([array(0.0, 0.5, 1.0, 1.0)], array(0, 0.5, 1))
    assert profile.values.tolist() == [0.75, 0.5, 0]
    assert optimality_gap([array(0, 1, 3)]).value == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    # Newcombe (1998), table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_equals_published_digits(successes, n, low, high):
    found = ends(wilson_interval(successes, n, 0.95))
    assert [round(end, 4) for end in found] == [low, high]
    assert wilson_interval(n, n, 0.95).high == 1
    assert wilson_interval(0, n, 0.95).low == 0


def test_bootstrap_of_two_values_by_hand():
    """The mean of two draws from 0 and 1 is 0, 1/2, 1 with chances 1/4, 1/2, 1/4."""
    figure = mean(array(0, 1))
    assert figure.interval(USUAL) == Interval(0, 1)
    assert figure.interval(Bootstrap(confidence=0.4)) == Interval(0.5, 0.5)


FIGURES = {
    "mean": lambda x, _: mean(x),
    "difference": lambda x, y: mean(x) - mean(y),
    "iqm": lambda x, y: interquartile_mean([x, y]),
    "improvement": improvement,
    "gap": lambda x, y: optimality_gap([x / 600, y / 600]),
}


@pytest.mark.parametrize("name", FIGURES)
def test_large_sample_interval_is_close_to_the_bootstraps(name, monkeypatch):
    figure = FIGURES[name](normal(60), normal(90, 550, seed=1))
    low, high = ends(figure.interval(USUAL))
    assert figure.interval_method == PERCENTILE_BOOTSTRAP
    monkeypatch.setattr(statistics, "MOST_RESAMPLED", 0)
    assert figure.interval_method == LARGE_SAMPLE
    assert ends(figure.interval(USUAL)) == pytest.approx(
        [low, high], abs=0.1 * (high - low)
    )


def test_large_sample_band_is_close_to_the_bootstraps(monkeypatch):
    profile = performance_profile([normal(200) / 1000, normal(300) / 1000], array(0.5))
    resampled = np.array(profile.ends(USUAL))
    monkeypatch.setattr(statistics, "MOST_RESAMPLED", 0)
    width = float(np.ptp(resampled))
    assert np.array(profile.ends(USUAL)) == pytest.approx(resampled, abs=0.1 * width)


def test_interval_depends_on_the_seed_but_not_on_order():
    values = np.arange(10.0)
    first = interquartile_mean([values]).interval(QUICK)
    assert interquartile_mean([values[::-1]]).interval(QUICK) == first
    other = Bootstrap(resamples=500, seed=1)
    assert interquartile_mean([values]).interval(other) != first


def test_single_values_have_no_interval():
    for figure in (mean(array(1)), improvement(array(1, 2), array(3))):
        assert (figure.interval(QUICK), figure.interval_method) == (None, None)


@pytest.mark.parametrize("wrong", [{"resamples": 10**7}, {"confidence": 1.0}])
def test_impossible_bootstraps_are_refused(wrong):
    with pytest.raises(InvalidArgument, match="but it is"):
        Bootstrap(**wrong)

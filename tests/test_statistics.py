# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.stats import mannwhitneyu, trim_mean

from mjrec.evaluation.statistics import (
    FloatArray,
    interquartile_mean,
    interquartile_mean_across,
    mean_probability_of_improvement,
    normal_quantile,
    optimality_gap,
    performance_profile,
    placements,
    probability_of_improvement,
    standard_deviation,
    task_means,
    wilson_interval,
)
from score_samples import TENTHS, X, Y, samples

RETURNS = npst.arrays(
    np.float64,
    st.integers(1, 12),
    # Few different ones, so that many are equal.
    elements=st.integers(-4, 4).map(float),
)


def array(*values: float) -> FloatArray:
    return np.array(values, dtype=np.float64)


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ([5], 5),
        ([1, 9], 5),
        ([1, 2, 9], 4),  # one is more than a quarter: none is left out
        ([100, 2, 4, -50], 3),
        ([1, 2, 3, 4, 100], 3),
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),
        ([0, 0, 0, 0, 1, 1, 1, 1], 0.5),
    ],
)
def test_interquartile_mean_by_hand(values: list[float], mean: float) -> None:
    """A quarter, rounded down, is left out at each end."""
    assert interquartile_mean(array(*values)) == mean


@given(RETURNS)
def test_interquartile_mean_is_the_trimmed_mean(values: FloatArray) -> None:
    """What scipy says."""
    assert interquartile_mean(values) == pytest.approx(trim_mean(values, 0.25))


def test_standard_deviation_is_that_of_a_sample() -> None:
    """Squares 9, 1, 1, 1, 0, 0, 4, 16 around 5 over 7."""
    values = array(2, 4, 4, 4, 5, 5, 7, 9)
    assert standard_deviation(values) == pytest.approx((32 / 7) ** 0.5)


@pytest.mark.parametrize("function", [interquartile_mean, standard_deviation])
def test_nothing_has_no_figures(function: object) -> None:
    """It is an error, and no NaN."""
    with pytest.raises(ValueError, match=r"."):
        function(array())  # type: ignore[operator]


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        # Newcombe (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        # Solved by hand: z^2 / (n + z^2), and its mirror image.
        (0, 10, 0.0000, 0.2775),
        (10, 10, 0.7225, 1.0000),
    ],
)
def test_wilson_interval_as_published(
    successes: int, n: int, low: float, high: float
) -> None:
    """To the digits that were printed."""
    interval = wilson_interval(successes, n)
    assert (round(interval.low, 4), round(interval.high, 4)) == (low, high)


@given(st.integers(1, 500), st.data(), st.floats(0.5, 0.999))
def test_wilson_ends_solve_the_score_equation(
    n: int, data: st.DataObject, confidence: float
) -> None:
    """|k/n - p| = z sqrt(p (1 - p) / n), and k/n is inside."""
    successes = data.draw(st.integers(0, n))
    interval = wilson_interval(successes, n, confidence)
    rate, z = successes / n, normal_quantile(confidence)
    assert 0 <= interval.low <= rate <= interval.high <= 1
    for end in (interval.low, interval.high):
        assert (rate - end) ** 2 == pytest.approx(z**2 * end * (1 - end) / n, abs=1e-9)


def test_wilson_interval_without_failures_ends_at_one() -> None:
    """Exactly: a page that says 0.9999999 would be wrong."""
    assert wilson_interval(7, 7).high == 1
    assert wilson_interval(0, 7).low == 0


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (3, 2), (-1, 2)])
def test_impossible_shares_are_refused(successes: int, n: int) -> None:
    """More successes than trials are a mistake of the caller."""
    with pytest.raises(ValueError, match="cannot be"):
        wilson_interval(successes, n)


def test_normal_quantile_is_in_every_table() -> None:
    """1.96 for 95 %."""
    assert normal_quantile(0.95) == pytest.approx(1.959963984540054)
    assert normal_quantile(0.99) == pytest.approx(2.5758293035489004)


def test_figures_across_tasks_are_rliables() -> None:
    """To the last digit but rounding."""
    x, y = samples(X), samples(Y)
    assert interquartile_mean_across(x) == pytest.approx(0.37966666666666665)
    assert optimality_gap(x) == pytest.approx(0.6111666666666666)
    assert task_means(x).mean() == pytest.approx(0.38883333333333336)
    assert np.median(task_means(x)) == pytest.approx(0.3785)
    assert mean_probability_of_improvement(x, y) == pytest.approx(0.3625)
    profile = [1, 57 / 60, 48 / 60, 39 / 60, 29 / 60, 15 / 60, 8 / 60, 3 / 60, 1 / 60]
    assert performance_profile(x, TENTHS) == pytest.approx([*profile, 0, 0])


def test_rliables_own_test_values() -> None:
    """Those of its metrics_test.py."""
    x = {"a": array(1, 2, 1, 2), "b": array(2, 2, 1, 1)}
    y = {"a": array(1, 2, 3), "b": array(1, 2, 3)}
    assert [interquartile_mean_across(each) for each in (x, y)] == [1.5, 2]
    assert [np.median(task_means(each)) for each in (x, y)] == [1.5, 2]
    assert mean_probability_of_improvement(x, y) == pytest.approx(1 / 3)


def test_tasks_count_alike_however_many_episodes_they_have() -> None:
    """Gap and profile are means over tasks; the interquartile mean is of episodes."""
    scores = {"few": array(1.0, 1.0), "many": np.zeros(98)}
    assert optimality_gap(scores) == 0.5
    assert performance_profile(scores, array(0.5)) == [0.5]
    assert interquartile_mean_across(scores) == 0


def test_more_than_one_makes_up_for_nothing() -> None:
    """A score of 3 is no shorter of 1 than a score of 1."""
    assert optimality_gap({"a": array(0, 1, 3)}) == pytest.approx(1 / 3)
    assert optimality_gap({"a": array(0, 1, 3)}, gamma=2) == pytest.approx(1)


def test_equal_to_the_threshold_is_not_above_it() -> None:
    """A strict inequality, as in the paper."""
    scores = {"a": array(0.0, 0.5, 1.0, 1.0)}
    assert performance_profile(scores, array(0, 0.5, 1)).tolist() == [0.75, 0.5, 0]


def test_placements_by_hand() -> None:
    """Of 1, 2, 2, 4: none is below 1, which equals one; and so on."""
    assert placements(array(1, 2, 5), array(1, 2, 2, 4)).tolist() == [0.125, 0.5, 1]


def test_probability_of_improvement_by_hand() -> None:
    """Ages of five men and four women with diabetes, of scipy's manual: U is 17."""
    men, women = array(19, 22, 16, 29, 24), array(20, 11, 17, 12)
    assert probability_of_improvement(men, women) == 17 / 20


@given(RETURNS, RETURNS)
def test_probability_of_improvement_is_mann_whitneys(
    x: FloatArray, y: FloatArray
) -> None:
    """U over the number of pairs, as scipy counts it."""
    # Only the statistic is asked for: its p-value of equal values is 0/0.
    with np.errstate(all="ignore"):
        u = mannwhitneyu(x, y, method="asymptotic").statistic
    assert probability_of_improvement(x, y) == pytest.approx(u / (len(x) * len(y)))


@given(RETURNS, RETURNS, st.integers(-5, 5))
def test_probability_of_improvement_is_symmetric(
    x: FloatArray, y: FloatArray, shift: int
) -> None:
    """One is better or the other, and where zero lies does not matter."""
    chance = probability_of_improvement(x, y)
    assert chance + probability_of_improvement(y, x) == pytest.approx(1)
    assert probability_of_improvement(x + shift, y + shift) == chance
    assert probability_of_improvement(x, x) == pytest.approx(0.5)


@given(RETURNS)
def test_order_of_episodes_does_not_matter(values: FloatArray) -> None:
    """Not even for the last digit."""
    shuffled = values[::-1]
    assert interquartile_mean(values) == interquartile_mean(shuffled)
    assert performance_profile({"a": values}, TENTHS).tolist() == (
        performance_profile({"a": shuffled}, TENTHS).tolist()
    )

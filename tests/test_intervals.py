# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjrec import InvalidArgument
from mjrec.evaluation import intervals
from mjrec.evaluation.intervals import (
    LARGE_SAMPLE,
    PERCENTILE_BOOTSTRAP,
    across_intervals,
    improvement_intervals,
    interval_method,
    iqm_difference_interval,
    mean_interval,
    task_intervals,
)
from mjrec.evaluation.statistics import FloatArray, probability_of_improvement
from mjrec.evaluation.summaries import Bootstrap, Interval
from score_samples import TENTHS, X, Y, samples

USUAL = Bootstrap()
QUICK = Bootstrap(resamples=500)


def normal(count: int, mean: float = 500.0, *, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(mean, 100, count)


@pytest.fixture
def large_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the large-sample intervals of whatever is asked."""
    monkeypatch.setattr(intervals, "MOST_RESAMPLED", 0)


def ends(interval: Interval | None) -> list[float]:
    assert interval is not None
    return [interval.low, interval.high]


def test_bootstrap_of_two_values_by_hand() -> None:
    """The mean of two draws from 0 and 1 is 0, 1/2, 1 with chances 1/4, 1/2, 1/4."""
    values = np.array([0.0, 1.0])
    wide = task_intervals(values, task="a", bootstrap=USUAL)
    narrow = task_intervals(values, task="a", bootstrap=Bootstrap(confidence=0.4))
    assert wide is not None
    assert narrow is not None
    assert wide.mean == Interval(0, 1)
    assert narrow.mean == Interval(0.5, 0.5)


def test_bootstrap_interval_of_the_mean_is_the_known_one() -> None:
    """Of 200 normal values: mean +- 1.96 s / sqrt(n), to a few percent of its width."""
    values = normal(200)
    found = ends(mean_interval(values, stratum="a", bootstrap=USUAL))
    reach = 1.96 * values.std() / np.sqrt(200)
    expected = [values.mean() - reach, values.mean() + reach]
    assert found == pytest.approx(expected, abs=reach * 0.05)


def test_intervals_across_tasks_are_rliables() -> None:
    """Those of rliable 1.2.0 from 20000 resamples (profile: 5000), to their noise."""
    found = across_intervals(samples(X), thresholds=TENTHS, bootstrap=USUAL)
    assert found is not None
    assert ends(found.iqm) == pytest.approx([0.3243, 0.4340], abs=0.004)
    assert ends(found.optimality_gap) == pytest.approx([0.5653, 0.6570], abs=0.004)
    low = [1.0, 0.9, 0.7, 0.533, 0.367, 0.15, 0.05, 0, 0, 0, 0]
    high = [1.0, 1.0, 0.883, 0.767, 0.6, 0.35, 0.217, 0.1, 0.05, 0, 0]
    assert found.profile_low == pytest.approx(low, abs=0.018)
    assert found.profile_high == pytest.approx(high, abs=0.018)
    better = improvement_intervals(samples(X), samples(Y), bootstrap=USUAL)
    assert ends(better.mean_probability) == pytest.approx([0.2658, 0.4629], abs=0.004)


@pytest.mark.parametrize("count", [50, 400])
def test_both_methods_agree(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a sample that either could do: to a tenth of the interval's width."""

    def found() -> list[float]:
        scores = {"a": normal(count, 0.5), "b": normal(2 * count, 0.6, seed=1)}
        scores = {task: np.clip(v / 500, -1, 1) for task, v in scores.items()}
        others = {task: v + 0.05 for task, v in scores.items()}
        across = across_intervals(scores, thresholds=TENTHS, bootstrap=USUAL)
        better = improvement_intervals(others, scores, bootstrap=USUAL)
        one = task_intervals(scores["a"], task="a", bootstrap=USUAL)
        assert across is not None
        assert one is not None
        every = [
            *(across.iqm, across.optimality_gap, one.mean, one.iqm),
            *(better.differences["a"], better.probabilities["a"]),
            better.mean_probability,
            iqm_difference_interval(others, scores, bootstrap=USUAL),
        ]
        return [end for interval in every for end in ends(interval)] + [
            *(across.profile_low[0], across.profile_high[0])
        ]

    resampled = np.array(found())
    monkeypatch.setattr(intervals, "MOST_RESAMPLED", 0)
    linearised = np.array(found())
    widths = np.repeat(resampled[1::2] - resampled[::2], 2)
    assert np.abs(resampled - linearised).max() > 0
    assert (np.abs(resampled - linearised) < 0.1 * widths).all()


def test_intervals_cover_the_mean_as_often_as_they_say() -> None:
    """Of 300 samples of 30, about 95 of 100; the bootstrap is known to be a bit low."""
    inside = 0
    for k in range(300):
        low, high = ends(
            mean_interval(normal(30, seed=k), stratum=str(k), bootstrap=QUICK)
        )
        inside += low <= 500 <= high
    assert 0.915 <= inside / 300 <= 0.985


@pytest.mark.usefixtures("large_samples")
def test_large_sample_intervals_cover_the_iqm_as_often_as_they_say() -> None:
    """The middle half of a symmetric distribution is around its middle."""
    inside = 0
    for k in range(300):
        found = task_intervals(normal(200, seed=k), task="a", bootstrap=QUICK)
        assert found is not None
        inside += found.iqm.low <= 500 <= found.iqm.high
    assert 0.915 <= inside / 300 <= 0.985


def test_same_seed_same_interval() -> None:
    """And another seed another."""
    values = normal(20)
    first = task_intervals(values, task="a", bootstrap=QUICK)
    assert task_intervals(values[::-1], task="a", bootstrap=QUICK) == first
    other = dataclasses.replace(QUICK, seed=1)
    assert task_intervals(values, task="a", bootstrap=other) != first


def test_draws_are_the_same_everywhere() -> None:
    """These bytes were right once: on another machine, with another NumPy, too."""
    (block,) = intervals._resamples({"a": 5, "b": 1000}, Bootstrap(resamples=2))
    assert block["a"].tolist() == [[1, 2, 3, 4, 4], [1, 4, 2, 4, 1]]
    assert block["b"][0, :5].tolist() == [789, 491, 122, 883, 930]


def test_a_task_does_not_depend_on_the_others() -> None:
    """Nor on their order: each has a stream of its own."""
    (alone,) = intervals._resamples({"a": 5}, QUICK)
    (between,) = intervals._resamples({"b": 9, "a": 5, "c": 7}, QUICK)
    assert np.array_equal(alone["a"], between["a"])
    assert not np.array_equal(between["a"], between["c"][:, :5] % 5)


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """However much memory is used."""
    values = normal(20)
    whole = task_intervals(values, task="a", bootstrap=QUICK)
    monkeypatch.setattr(intervals, "_BLOCK", 30)
    assert task_intervals(values, task="a", bootstrap=QUICK) == whole


def test_strata_keep_their_sizes() -> None:
    """Of two tasks that each have one score, again and again, nothing varies."""
    scores = {"a": np.zeros(3), "b": np.ones(5)}
    found = across_intervals(scores, thresholds=TENTHS, bootstrap=QUICK)
    assert found is not None
    # Of 0 0 0 1 1 1 1 1, two are left out at each end.
    assert found.iqm == Interval(0.75, 0.75)
    assert found.optimality_gap == Interval(0.5, 0.5)
    assert found.profile_low.tolist() == [0.5] * 10 + [0]


def test_draws_are_even() -> None:
    """Each of seven episodes is drawn a seventh of the time."""
    (block,) = intervals._resamples({"a": 7}, USUAL)
    counts = np.bincount(block["a"].ravel(), minlength=7)
    assert len(counts) == 7
    assert counts == pytest.approx(np.full(7, 10_000), rel=0.04)


def test_resampled_probability_is_that_of_the_resample() -> None:
    """The one formula by counting, the other by sorting."""
    rng = np.random.default_rng(0)
    x, y = np.sort(rng.integers(0, 6, 7) * 1.0), np.sort(rng.integers(0, 6, 9) * 1.0)
    how = Bootstrap(resamples=40)
    _, chances = intervals._resampled_improvement(x, y, task="a", bootstrap=how)
    (block,) = intervals._resamples({"x:a": 7, "y:a": 9}, how)
    assert chances.tolist() == [
        pytest.approx(probability_of_improvement(x[of_x], y[of_y]))
        for of_x, of_y in zip(block["x:a"], block["y:a"], strict=True)
    ]


def test_a_single_episode_has_no_interval() -> None:
    """One of no width would say that all is known."""
    one, two = np.ones(1), np.arange(2.0)
    assert task_intervals(one, task="a", bootstrap=QUICK) is None
    assert mean_interval(one, stratum="a", bootstrap=QUICK) is None
    scores = {"a": one, "b": two}
    assert across_intervals(scores, thresholds=TENTHS, bootstrap=QUICK) is None
    assert iqm_difference_interval(scores, scores, bootstrap=QUICK) is None
    found = improvement_intervals(scores, scores, bootstrap=QUICK)
    assert list(found.differences) == ["b"]
    assert found.mean_probability is None


@pytest.mark.parametrize(
    ("counts", "method"),
    [
        ({}, None),
        ({"a": 1, "b": 50}, None),
        ({"a": 3000}, PERCENTILE_BOOTSTRAP),
        ({"a": 3001}, LARGE_SAMPLE),
        ({"a": 1500, "b": 1501}, LARGE_SAMPLE),
    ],
)
def test_method_by_the_number_of_episodes(
    counts: dict[str, int], method: str | None
) -> None:
    """Of all that a figure is of."""
    assert interval_method(counts) == method


def test_error_of_a_probability_by_hand() -> None:
    """Variances of the placements, 1/128 over 2 and 9/64 over 4."""
    x, y = np.array([0.0, 1.0]), np.array([0.0, 2.0, 2.0, 2.0])
    error = intervals._error_of_probability(x, y)
    assert error == pytest.approx((1 / 256 + 9 / 256) ** 0.5)


@pytest.mark.usefixtures("large_samples")
def test_probabilities_stay_between_zero_and_one() -> None:
    """Also where a standard error reaches further."""
    x, y = {"a": np.array([0.0, 2.0, 3.0])}, {"a": np.array([-1.0, 0.0, 1.0])}
    found = improvement_intervals(x, y, bootstrap=QUICK)
    assert found.probabilities["a"].high == 1
    assert found.mean_probability is not None
    assert found.mean_probability.high == 1


@pytest.mark.parametrize(
    "wrong",
    [{"resamples": 0}, {"resamples": 10**7}, {"confidence": 1.0}, {"seed": -1}],
)
def test_impossible_bootstraps_are_refused(wrong: dict[str, int]) -> None:
    """Before anything is read or run."""
    with pytest.raises(InvalidArgument, match="got"):
        Bootstrap(**wrong)  # type: ignore[arg-type]

# SPDX-License-Identifier: Apache-2.0
import math
import tracemalloc

import numpy as np
import pytest

from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.statistics import (
    LARGE_SAMPLE,
    PERCENTILE_BOOTSTRAP,
    Bootstrap,
    wilson_interval,
)
from mjrec.evaluation.summaries import (
    PROFILE_THRESHOLDS,
    AcrossTasks,
    TaskSummary,
    default_score_range,
    summarize_across,
    summarize_results,
    summarize_task,
)

TASK = "dm_control/walker-walk"
QUICK = Bootstrap(resamples=500)


def result(seed, episode, total, **more):
    return EpisodeResult(
        task=TASK,
        seed=seed,
        episode=episode,
        total_reward=total,
        terminated=None if total is None else episode % 2 == 0,
        truncated=None if total is None else episode % 2 == 1,
        failure="it raised" if total is None else None,
        **{"length": 10, **more},
    )


def test_figures_of_a_task():
    summary = summarize_results(
        TASK,
        [
            result(0, 0, 2.0, success=True, warnings={"BADQACC": 1}),
            result(0, 1, 4.0, success=False, length=30),
            result(0, 2, None, length=7, warnings={"BADQPOS": 1, "BADQACC": 2}),
            result(1, 0, 4.0, success=True),
            result(1, 1, 10.0),
        ],
        score_range=(0, 100),
        bootstrap=QUICK,
    )
    assert (summary.runs, summary.episodes, summary.failed) == (2, 4, 1)
    assert (summary.mean, summary.median, summary.iqm) == (5, 4, 4)
    assert summary.std == pytest.approx(math.sqrt(36 / 3))
    assert (summary.minimum, summary.maximum) == (2, 10)
    assert summary.mean_length == 15
    assert (summary.terminated, summary.truncated) == (2, 2)
    # A failed episode is no success.
    assert (summary.success_known, summary.success_rate) == (4, 0.5)
    assert summary.success_interval == wilson_interval(2, 4, 0.95)
    assert dict(summary.warnings) == {"BADQACC": 3, "BADQPOS": 1}
    assert summary.score_range == (0, 100)
    assert summary.interval_method == PERCENTILE_BOOTSTRAP
    assert 2 <= summary.mean_interval.low < 5 < summary.mean_interval.high <= 10


def test_figures_of_none_or_one_episode():
    nothing = summarize_task(TASK, total_rewards=[], runs=0)
    assert nothing == TaskSummary(task=TASK, runs=0, episodes=0)
    failed = summarize_results(TASK, [result(0, 0, None)] * 2)
    assert (failed.episodes, failed.failed, failed.mean) == (0, 2, None)
    one = summarize_task(TASK, total_rewards=[3.0], runs=1, success=[math.nan])
    assert (one.mean, one.iqm, one.median, one.std) == (3, 3, 3, None)
    assert (one.mean_interval, one.interval_method) == (None, None)
    assert (one.success_known, one.success_rate) == (0, None)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_nan_and_infinite_returns_are_counted_and_leave_no_figures(wrong):
    summary = summarize_task(
        TASK, total_rewards=[1, 2, wrong], runs=1, lengths=[5, 5, 5]
    )
    assert (summary.episodes, summary.not_finite) == (3, 1)
    assert (summary.mean, summary.median, summary.maximum) == (None, None, None)
    assert (summary.mean_interval, summary.mean_length) == (None, 5)
    across = summarize_across({TASK: [1, wrong]}, {TASK: (0, 1000)})
    assert across.left_out == {TASK: "1 of 2 returns are NaN or infinite"}
    # A sum that overflows leaves no mean.
    huge = summarize_task(TASK, total_rewards=[1e308] * 4, runs=1)
    assert (huge.mean, huge.mean_interval, huge.maximum) == (None, None, 1e308)


def test_a_million_episodes_take_little_more_memory():
    returns = np.random.default_rng(0).normal(500, 100, 1_000_000)
    tracemalloc.start()
    summary = summarize_task(TASK, total_rewards=returns, runs=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * returns.nbytes
    assert summary.interval_method == LARGE_SAMPLE
    assert summary.mean_interval.high - summary.mean_interval.low == pytest.approx(
        2 * 1.96 * 0.1, rel=0.01
    )


def test_bounded_tasks_of_the_suite_have_a_default_score_range():
    assert default_score_range(TASK, None) == (0, 1000)
    assert default_score_range(TASK, 250) == (0, 250)
    assert default_score_range("dm_control/lqr-lqr_2_1", None) is None
    assert default_score_range("HalfCheetah-v5", None) is None


@pytest.mark.dm_control
def test_the_suites_episodes_have_a_thousand_steps():
    """The default range relies on it."""
    suite = pytest.importorskip("dm_control.suite")
    for domain, task in dict(suite.BENCHMARKING).items():
        assert suite.load(domain, task)._step_limit == 1000, domain


def test_figures_across_tasks():
    """Tasks without scores are left out, with the reason."""
    returns = {"a": [-10, 6], "b": [5, 5], "c": [0.5, 1.0], "y": []}
    scales = {"a": (-10, 10), "b": (0, 10), "c": (0, 1), "y": (0, 1)}
    without = {"x": [1], "dm_control/lqr-x": [1]}
    across = summarize_across({**returns, **without}, scales, bootstrap=QUICK)
    # Scores 0, .8; .5, .5; .5, 1.
    assert across.tasks == ("a", "b", "c")
    assert across.left_out == {
        "x": "it has no default scale, and no scale was given",
        "dm_control/lqr-x": "its rewards are unbounded",
        "y": "no episode was completed",
    }
    assert (across.mean, across.median) == (pytest.approx(0.55), pytest.approx(0.5))
    # Without the lowest and the highest score.
    assert across.iqm == pytest.approx(2.3 / 4)
    assert across.optimality_gap == pytest.approx(0.45)
    profile = across.profile
    assert profile.thresholds == PROFILE_THRESHOLDS
    assert [profile.shares[k] for k in (0, 50, 100)] == pytest.approx([5 / 6, 2 / 6, 0])
    for low, share, high in zip(profile.low, profile.shares, profile.high, strict=True):
        assert low - 1e-12 <= share <= high + 1e-12


def test_a_task_of_one_episode_leaves_no_intervals():
    scales = {"a": (0.0, 1.0), "b": (0.0, 1.0)}
    across = summarize_across({"a": [0.5], "b": [0.1, 0.9]}, scales, bootstrap=QUICK)
    assert across.iqm is not None
    assert (across.iqm_interval, across.interval_method) == (None, None)
    assert across.profile.low == across.profile.high == across.profile.shares
    assert summarize_across({}, {}) == AcrossTasks(tasks=())

# SPDX-License-Identifier: Apache-2.0
"""From the results of episodes to what is said of them.

Failed episodes have no return and no length: they are counted, and are no part of the
figures. A claim about a task needs `failed` to be 0.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from . import intervals, statistics
from .episode_results import EpisodeResult
from .statistics import FloatArray
from .summaries import AcrossTasks, Bootstrap, Interval, Profile, TaskSummary

PROFILE_THRESHOLDS: Final = tuple(k / 100 for k in range(101))

_SUITE: Final = "dm_control/"
_SUITE_STEPS: Final = 1000
_UNBOUNDED_IN_SUITE: Final = "dm_control/lqr-"


def summarize_task(
    task: str,
    *,
    total_rewards: npt.ArrayLike,
    runs: int,
    lengths: npt.ArrayLike | None = None,
    terminated: npt.ArrayLike | None = None,
    truncated: npt.ArrayLike | None = None,
    success: npt.ArrayLike | None = None,
    failed: int = 0,
    warnings: Mapping[str, int] | None = None,
    score_range: tuple[float, float] | None = None,
    bootstrap: Bootstrap | None = None,
) -> TaskSummary:
    """Return what is said of one task.

    The arrays have an element for each completed episode, in the same order; how they
    are ordered changes no figure by more than rounding. A million episodes take a
    second.

    Args:
        task: its name.
        total_rewards: the returns.
        runs: how many seeds, or monitors, the episodes are of.
        lengths: in steps; None where nobody wrote them down.
        terminated: truth values; None likewise.
        truncated: likewise.
        success: 1 and 0, NaN where the environment said nothing; None is all NaN.
        failed: how many episodes could not be completed.
        warnings: how often MuJoCo warned, by kind, in all episodes, failed ones too.
        score_range: the returns that count as 0 and as 1.
        bootstrap: how intervals are made; as `Bootstrap()` says, if None.
    """
    returns = np.asarray(total_rewards, dtype=np.float64)
    how = bootstrap or Bootstrap()
    summary = TaskSummary(
        task=task,
        runs=runs,
        episodes=len(returns),
        failed=failed,
        mean_length=_mean_length(lengths),
        terminated=_count(terminated),
        truncated=_count(truncated),
        warnings=dict(sorted((warnings or {}).items())),
        score_range=score_range,
    )
    summary = _with_success(summary, success, how)
    not_finite = int(np.count_nonzero(~np.isfinite(returns)))
    if not_finite:
        return dataclasses.replace(summary, not_finite=not_finite)
    return _with_returns(summary, returns, how) if len(returns) else summary


def summarize_results(
    task: str,
    results: Sequence[EpisodeResult],
    *,
    score_range: tuple[float, float] | None = None,
    bootstrap: Bootstrap | None = None,
) -> TaskSummary:
    """Return what is said of one task, all of whose results these are."""
    completed = [result for result in results if result.failure is None]
    warnings: Counter[str] = Counter()
    for result in results:
        warnings.update(result.warnings)
    return summarize_task(
        task,
        total_rewards=[_number(result.total_reward) for result in completed],
        runs=len({result.seed for result in results}),
        lengths=[result.length for result in completed],
        terminated=[bool(result.terminated) for result in completed],
        truncated=[bool(result.truncated) for result in completed],
        success=[_number(result.success) for result in completed],
        failed=len(results) - len(completed),
        warnings=warnings,
        score_range=score_range,
        bootstrap=bootstrap,
    )


def default_score_range(
    task: str, step_limit: int | None = None
) -> tuple[float, float] | None:
    """Return the returns that count as 0 and as 1, or None where nobody can say.

    The tasks of the dm_control suite reward every step with 0 to 1 and have 1000 steps
    (arXiv 1801.00690), all but `lqr`, whose rewards have no bound.

    Args:
        task: its name.
        step_limit: the most steps of an episode, where that was asked for.
    """
    if not task.startswith(_SUITE) or task.startswith(_UNBOUNDED_IN_SUITE):
        return None
    return 0.0, float(min(step_limit or _SUITE_STEPS, _SUITE_STEPS))


def scaled(total_rewards: FloatArray, score_range: tuple[float, float]) -> FloatArray:
    """Return scores: 0 and 1 where returns are at the ends of the range."""
    low, high = score_range
    return (total_rewards - low) / (high - low)


def split_by_scale(
    total_rewards: Mapping[str, npt.ArrayLike],
    score_ranges: Mapping[str, tuple[float, float] | None],
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return the scores of the tasks that have any, and why the others have none.

    Args:
        total_rewards: the returns of the completed episodes, for each task.
        score_ranges: for each task; one that is not there has no scale.
    """
    scores: dict[str, FloatArray] = {}
    left_out: dict[str, str] = {}
    for task, values in total_rewards.items():
        returns = np.asarray(values, dtype=np.float64)
        score_range = score_ranges.get(task)
        infinite = int(np.count_nonzero(~np.isfinite(returns)))
        if score_range is None:
            left_out[task] = _why_no_scale(task)
        elif not len(returns):
            left_out[task] = "no episode was completed"
        elif infinite:
            left_out[task] = f"{infinite} of {len(returns)} returns are NaN or infinite"
        else:
            scores[task] = scaled(returns, score_range)
    return scores, left_out


def summarize_across(
    scores: Mapping[str, npt.ArrayLike],
    *,
    left_out: Mapping[str, str] | None = None,
    bootstrap: Bootstrap | None = None,
) -> AcrossTasks:
    """Return what is said of several tasks.

    Args:
        scores: of the completed episodes of each task; finite, and at least one.
        left_out: further tasks, and why they are not among them.
        bootstrap: how intervals are made; as `Bootstrap()` says, if None.
    """
    samples = {task: np.asarray(s, dtype=np.float64) for task, s in scores.items()}
    others = dict(left_out or {})
    if not samples:
        return AcrossTasks(tasks=(), left_out=others)
    thresholds = np.array(PROFILE_THRESHOLDS)
    found = intervals.across_intervals(
        samples, thresholds=thresholds, bootstrap=bootstrap or Bootstrap()
    )
    means = statistics.task_means(samples)
    shares = statistics.performance_profile(samples, thresholds)
    return AcrossTasks(
        tasks=tuple(samples),
        left_out=others,
        mean=float(means.mean()),
        median=float(np.median(means)),
        iqm=statistics.interquartile_mean_across(samples),
        iqm_interval=found.iqm if found else None,
        optimality_gap=statistics.optimality_gap(samples),
        optimality_gap_interval=found.optimality_gap if found else None,
        profile=Profile(
            thresholds=PROFILE_THRESHOLDS,
            shares=tuple(shares.tolist()),
            low=tuple((found.profile_low if found else shares).tolist()),
            high=tuple((found.profile_high if found else shares).tolist()),
        ),
        interval_method=intervals.interval_method(
            {task: len(values) for task, values in samples.items()}
        ),
    )


def _with_returns(
    summary: TaskSummary, returns: FloatArray, bootstrap: Bootstrap
) -> TaskSummary:
    # Returns near the largest number there is have a sum that is none.
    with np.errstate(over="ignore", invalid="ignore"):
        found = intervals.task_intervals(
            returns, task=summary.task, bootstrap=bootstrap
        )
        std = statistics.standard_deviation(returns) if len(returns) > 1 else None
        return dataclasses.replace(
            summary,
            mean=_figure(returns.mean()),
            std=_figure(std),
            median=_figure(np.median(returns)),
            iqm=_figure(statistics.interquartile_mean(returns)),
            minimum=float(returns.min()),
            maximum=float(returns.max()),
            mean_interval=_interval(found.mean) if found else None,
            iqm_interval=_interval(found.iqm) if found else None,
            interval_method=intervals.interval_method({summary.task: len(returns)}),
        )


def _with_success(
    summary: TaskSummary, success: npt.ArrayLike | None, bootstrap: Bootstrap
) -> TaskSummary:
    said = np.asarray([] if success is None else success, dtype=np.float64)
    said = said[~np.isnan(said)]
    if not len(said):
        return summary
    # Who fails to complete an episode does not succeed in it.
    known = len(said) + summary.failed
    successes = int(np.count_nonzero(said))
    return dataclasses.replace(
        summary,
        success_known=known,
        success_rate=successes / known,
        success_interval=statistics.wilson_interval(
            successes, known, bootstrap.confidence
        ),
    )


def _why_no_scale(task: str) -> str:
    if task.startswith(_UNBOUNDED_IN_SUITE):
        return "its rewards have no bound"
    return "it has no scale of its own, and none was given"


def _mean_length(lengths: npt.ArrayLike | None) -> float | None:
    counts = np.asarray([] if lengths is None else lengths)
    return float(counts.mean()) if len(counts) else None


def _count(truths: npt.ArrayLike | None) -> int:
    return 0 if truths is None else int(np.count_nonzero(truths))


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _figure(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _interval(interval: Interval) -> Interval | None:
    is_finite = math.isfinite(interval.low) and math.isfinite(interval.high)
    return interval if is_finite else None

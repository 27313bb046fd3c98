# SPDX-License-Identifier: Apache-2.0
"""Summaries of a single task and of all tasks together.

Failed episodes have no return. They are counted but not included in the figures, so
conclusions about a task are valid only if `failed` and `not_finite` are 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from . import statistics
from .episode_results import EpisodeResult
from .statistics import Bootstrap, FloatArray, Interval, wilson_interval

PROFILE_THRESHOLDS: Final = tuple(k / 100 for k in range(101))

_SUITE: Final = "dm_control/"
_SUITE_STEPS: Final = 1000
_UNBOUNDED_IN_SUITE: Final = "dm_control/lqr-"


@dataclass(frozen=True, kw_only=True)
class TaskSummary:
    """The summary of one task. Unknown figures are None.

    Attributes:
        task: the task's name.
        runs: number of seeds with episodes, or number of monitors if a monitor
            directory is summarized.
        episodes: number of completed episodes. The figures are computed from these.
        failed: number of failed episodes.
        mean: mean return.
        std: sample standard deviation of the returns, with the divisor n - 1.
        median: median return.
        iqm: interquartile mean of the returns.
        minimum: lowest return.
        maximum: highest return.
        mean_interval: confidence interval of the mean.
        iqm_interval: confidence interval of the interquartile mean.
        mean_length: mean length of the episodes, in steps.
        terminated: number of episodes that the task ended.
        truncated: number of episodes that a limit outside the task ended.
        success_known: number of episodes known to be successful or unsuccessful. If the
            task reports success, failed episodes count as unsuccessful.
        success_rate: share of successful episodes among the `success_known` episodes.
        success_interval: Wilson's interval for the success rate.
        warnings: number of MuJoCo warnings, by kind.
        score_range: the returns that correspond to scores of 0 and 1; None if the task
            has no scale.
        not_finite: number of returns that are NaN or infinite. If there are any, no
            figures are computed from the returns: including them would make the figures
            meaningless, and excluding them would make the figures misleading.
        interval_method: name of the method for the intervals of the mean and the
            interquartile mean.
    """

    task: str
    runs: int
    episodes: int
    failed: int = 0
    mean: float | None = None
    std: float | None = None
    median: float | None = None
    iqm: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    mean_interval: Interval | None = None
    iqm_interval: Interval | None = None
    mean_length: float | None = None
    terminated: int = 0
    truncated: int = 0
    success_known: int = 0
    success_rate: float | None = None
    success_interval: Interval | None = None
    warnings: Mapping[str, int] = field(default_factory=dict)
    score_range: tuple[float, float] | None = None
    not_finite: int = 0
    interval_method: str | None = None


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A performance profile: the share of scores above each threshold.

    Attributes:
        thresholds: the thresholds, in ascending order.
        shares: share of scores above each threshold, averaged over tasks.
        low: lower ends of the pointwise intervals. Equal to `shares` if there are no
            intervals (`AcrossTasks.interval_method` is None).
        high: upper ends of the pointwise intervals. Equal to `shares` without
            intervals.
    """

    thresholds: tuple[float, ...]
    shares: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class AcrossTasks:
    """The summary of all tasks that have a scale, computed from scores.

    Attributes:
        tasks: the tasks with a scale.
        left_out: reasons why the other tasks are left out, keyed by task.
        mean: mean of the tasks' mean scores.
        median: median of the tasks' mean scores.
        iqm: interquartile mean of all scores.
        iqm_interval: confidence interval of the interquartile mean.
        optimality_gap: average amount by which scores fall short of 1.
        optimality_gap_interval: confidence interval of the optimality gap.
        profile: performance profile of all scores.
        interval_method: name of the method for the intervals; None if there are no
            intervals because a task has only one episode.
    """

    tasks: tuple[str, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    mean: float | None = None
    median: float | None = None
    iqm: float | None = None
    iqm_interval: Interval | None = None
    optimality_gap: float | None = None
    optimality_gap_interval: Interval | None = None
    profile: Profile | None = None
    interval_method: str | None = None


def summarize_task(
    task: str,
    *,
    total_rewards: npt.ArrayLike,
    runs: int,
    lengths: npt.ArrayLike = (),
    terminated: npt.ArrayLike = (),
    truncated: npt.ArrayLike = (),
    success: npt.ArrayLike = (),
    failed: int = 0,
    warnings: Mapping[str, int] | None = None,
    score_range: tuple[float, float] | None = None,
    bootstrap: Bootstrap | None = None,
) -> TaskSummary:
    """Summarize the episodes of one task.

    All arrays have one element per completed episode, in the same order. The order
    affects the figures only by rounding errors. A million episodes take a second.

    Args:
        task: the task's name.
        total_rewards: the returns.
        runs: number of seeds or monitors that produced the episodes.
        lengths: lengths in steps; empty if they were not recorded.
        terminated: whether the task ended each episode; empty if not recorded.
        truncated: whether a limit outside the task ended each episode; empty if not
            recorded.
        success: 1 for a success, 0 otherwise, NaN if the environment did not report it;
            empty if not recorded.
        failed: number of episodes that could not be completed.
        warnings: number of MuJoCo warnings by kind in all episodes, including failed
            episodes.
        score_range: the returns that correspond to scores of 0 and 1.
        bootstrap: settings for the confidence intervals; None for `Bootstrap()`.
    """
    returns = np.asarray(total_rewards, dtype=np.float64)
    how = bootstrap or Bootstrap()
    not_finite = int(np.count_nonzero(~np.isfinite(returns)))
    figures: dict[str, Any] = {}
    if len(returns) and not not_finite:
        figures = _figures(returns, how)
    return TaskSummary(
        task=task,
        runs=runs,
        episodes=len(returns),
        failed=failed,
        mean_length=float(np.asarray(lengths).mean()) if np.size(lengths) else None,
        terminated=int(np.count_nonzero(terminated)),
        truncated=int(np.count_nonzero(truncated)),
        warnings=dict(sorted((warnings or {}).items())),
        score_range=score_range,
        not_finite=not_finite,
        **_successes(success, failed, how),
        **figures,
    )


def summarize_results(
    task: str,
    results: Sequence[EpisodeResult],
    *,
    score_range: tuple[float, float] | None = None,
    bootstrap: Bootstrap | None = None,
) -> TaskSummary:
    """Summarize one task from the results of all its episodes."""
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
    """Return the returns for scores of 0 and 1, or None if the task has no default.

    Tasks in the dm_control suite have 1000 steps with rewards from 0 to 1 (arXiv
    1801.00690). The exception is `lqr`, whose rewards are unbounded.

    Args:
        task: the task's name.
        step_limit: maximum number of steps per episode; None for 1000 steps.
    """
    if not task.startswith(_SUITE) or task.startswith(_UNBOUNDED_IN_SUITE):
        return None
    return 0.0, float(min(step_limit or _SUITE_STEPS, _SUITE_STEPS))


def scaled(total_rewards: FloatArray, score_range: tuple[float, float]) -> FloatArray:
    """Convert returns to scores, so that the ends of the range become 0 and 1."""
    low, high = score_range
    return (total_rewards - low) / (high - low)


def summarize_across(
    total_rewards: Mapping[str, npt.ArrayLike],
    score_ranges: Mapping[str, tuple[float, float] | None],
    *,
    bootstrap: Bootstrap | None = None,
) -> AcrossTasks:
    """Summarize all tasks that have a scale.

    Args:
        total_rewards: returns of the completed episodes, by task.
        score_ranges: the returns that correspond to scores of 0 and 1, by task. A task
            has no scale if its range is missing or None.
        bootstrap: settings for the confidence intervals; None for `Bootstrap()`.
    """
    scores: dict[str, FloatArray] = {}
    left_out: dict[str, str] = {}
    for task, values in total_rewards.items():
        returns = np.asarray(values, dtype=np.float64)
        score_range = score_ranges.get(task)
        if score_range is None:
            left_out[task] = _why_no_scale(task)
        elif not len(returns):
            left_out[task] = "no episode was completed"
        elif wrong := np.count_nonzero(~np.isfinite(returns)):
            left_out[task] = f"{wrong} of {len(returns)} returns are NaN or infinite"
        else:
            scores[task] = scaled(returns, score_range)
    if not scores:
        return AcrossTasks(tasks=(), left_out=left_out)
    samples = scores.values()
    how = bootstrap or Bootstrap()
    means = [sample.mean() for sample in samples]
    iqm = statistics.interquartile_mean(samples)
    gap = statistics.optimality_gap(samples)
    profile = statistics.performance_profile(samples, np.array(PROFILE_THRESHOLDS))
    shares = profile.values
    low, high = profile.ends(how) or (shares, shares)
    return AcrossTasks(
        tasks=tuple(scores),
        left_out=left_out,
        mean=float(np.mean(means)),
        median=float(np.median(means)),
        iqm=iqm.value,
        iqm_interval=iqm.interval(how),
        optimality_gap=gap.value,
        optimality_gap_interval=gap.interval(how),
        profile=Profile(
            thresholds=PROFILE_THRESHOLDS,
            shares=tuple(shares.tolist()),
            low=tuple(np.clip(low, 0, 1).tolist()),
            high=tuple(np.clip(high, 0, 1).tolist()),
        ),
        interval_method=iqm.interval_method,
    )


def _figures(returns: FloatArray, how: Bootstrap) -> dict[str, Any]:
    mean = statistics.mean(returns)
    iqm = statistics.interquartile_mean([returns])
    # The sum of returns may overflow if they are close to the largest float.
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            "mean": _finite(mean.value),
            "std": _finite(np.std(returns, ddof=1)) if len(returns) > 1 else None,
            "median": _finite(np.median(returns)),
            "iqm": _finite(iqm.value),
            "minimum": float(returns.min()),
            "maximum": float(returns.max()),
            "mean_interval": _finite_interval(mean.interval(how)),
            "iqm_interval": _finite_interval(iqm.interval(how)),
            "interval_method": mean.interval_method,
        }


def _successes(success: npt.ArrayLike, failed: int, how: Bootstrap) -> dict[str, Any]:
    known_successes = np.asarray(success, dtype=np.float64)
    known_successes = known_successes[~np.isnan(known_successes)]
    if not len(known_successes):
        return {}
    # A failed episode counts as unsuccessful.
    known = len(known_successes) + failed
    successes = int(np.count_nonzero(known_successes))
    return {
        "success_known": known,
        "success_rate": successes / known,
        "success_interval": wilson_interval(successes, known, how.confidence),
    }


def _why_no_scale(task: str) -> str:
    if task.startswith(_UNBOUNDED_IN_SUITE):
        return "its rewards are unbounded"
    return "it has no default scale, and no scale was given"


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _finite(value: float | np.floating[Any]) -> float | None:
    return float(value) if math.isfinite(value) else None


def _finite_interval(interval: Interval | None) -> Interval | None:
    if interval is None or not math.isfinite(interval.high - interval.low):
        return None
    return interval

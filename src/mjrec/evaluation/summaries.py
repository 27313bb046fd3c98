# SPDX-License-Identifier: Apache-2.0
"""What is said of the episodes of a task, and of several tasks.

Failed episodes have no return and no length: they are counted, and are no part of the
figures. A claim about a task needs `failed` and `not_finite` to be 0.
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
    """What is said of one task. What cannot be said is None.

    Attributes:
        task: its name.
        runs: how many seeds (of a monitor directory: monitors) have episodes.
        episodes: how many were completed; the figures below are theirs.
        failed: how many were not.
        mean: of the returns.
        std: of the returns, with n - 1.
        median: of the returns.
        iqm: the interquartile mean of the returns.
        minimum: of the returns.
        maximum: of the returns.
        mean_interval: of the mean.
        iqm_interval: of the interquartile mean.
        mean_length: of the episodes, in steps.
        terminated: how many the task ended.
        truncated: how many a limit from outside ended.
        success_known: of how many episodes, failed ones included, it is known whether
            they were a success; a failed one was none where the task says of any.
        success_rate: of those.
        success_interval: Wilson's, of the rate.
        warnings: how often MuJoCo warned, by kind.
        score_range: the returns that count as 0 and as 1; None where the task has no
            scale.
        not_finite: how many of the returns are NaN or infinite. Where any is, there
            are no figures of the returns: without it they would say too much, and
            with it nothing.
        interval_method: how the intervals of mean and interquartile mean were made.
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
    """A performance profile: which share of the scores lies above a threshold.

    Attributes:
        thresholds: rising.
        shares: for each threshold the share of scores above it, averaged over tasks.
        low: the pointwise interval's lower end; the share itself where there are no
            intervals, as `AcrossTasks.interval_method` tells.
        high: its upper end; likewise.
    """

    thresholds: tuple[float, ...]
    shares: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class AcrossTasks:
    """What is said of all tasks that have a scale, by their scores from 0 to 1.

    Attributes:
        tasks: which ones.
        left_out: the others, each with the reason.
        mean: of the tasks' mean scores.
        median: of the tasks' mean scores.
        iqm: the interquartile mean of all scores.
        iqm_interval: of that.
        optimality_gap: by how much scores fall short of 1, on average.
        optimality_gap_interval: of that.
        profile: of all scores.
        interval_method: how the intervals were made; None where there are none,
            because a task has a single episode.
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
    """Return what is said of one task.

    The arrays have an element for each completed episode, in the same order; how they
    are ordered changes no figure by more than rounding. A million episodes take a
    second.

    Args:
        task: its name.
        total_rewards: the returns.
        runs: how many seeds, or monitors, the episodes are of.
        lengths: in steps; empty where they were not recorded.
        terminated: truth values; nothing likewise.
        truncated: likewise.
        success: 1 and 0, NaN where the environment said nothing; nothing likewise.
        failed: how many episodes could not be completed.
        warnings: how often MuJoCo warned, by kind, in all episodes, failed ones too.
        score_range: the returns that count as 0 and as 1.
        bootstrap: how intervals are made; as `Bootstrap()` says, if None.
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
    """Return the returns that count as 0 and as 1; None where they are unknown.

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


def summarize_across(
    total_rewards: Mapping[str, npt.ArrayLike],
    score_ranges: Mapping[str, tuple[float, float] | None],
    *,
    bootstrap: Bootstrap | None = None,
) -> AcrossTasks:
    """Return what is said of all tasks that have a scale.

    Args:
        total_rewards: the returns of the completed episodes, for each task.
        score_ranges: the returns that count as 0 and as 1; a task that is not there has
            no scale.
        bootstrap: how intervals are made; as `Bootstrap()` says, if None.
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
    # Returns near the largest number there is have a sum that is none.
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
    # Who fails to complete an episode does not succeed in it.
    known = len(known_successes) + failed
    successes = int(np.count_nonzero(known_successes))
    return {
        "success_known": known,
        "success_rate": successes / known,
        "success_interval": wilson_interval(successes, known, how.confidence),
    }


def _why_no_scale(task: str) -> str:
    if task.startswith(_UNBOUNDED_IN_SUITE):
        return "its rewards have no bound"
    return "it has no scale of its own, and none was given"


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _finite(value: float | np.floating[Any]) -> float | None:
    return float(value) if math.isfinite(value) else None


def _finite_interval(interval: Interval | None) -> Interval | None:
    if interval is None or not math.isfinite(interval.high - interval.low):
        return None
    return interval

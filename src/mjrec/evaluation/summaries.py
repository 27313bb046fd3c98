# SPDX-License-Identifier: Apache-2.0
"""What is said of the episodes of a task, and of several tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ..errors import InvalidArgument

_MOST_RESAMPLES = 1_000_000


@dataclass(frozen=True)
class Interval:
    """A confidence interval.

    Attributes:
        low: its lower end.
        high: its upper end.
    """

    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """How confidence intervals are made.

    Attributes:
        resamples: how many.
        seed: of the generator that draws them.
        confidence: the share of the intervals that hold the true value.
        method: in words, for reports.

    Raises:
        InvalidArgument: there are no such intervals.
    """

    resamples: int = 10_000
    seed: int = 0
    confidence: float = 0.95
    method: str = "percentile bootstrap over episodes, stratified by task"

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

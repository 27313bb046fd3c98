# SPDX-License-Identifier: Apache-2.0
"""From episodes, one after the other, to columns: little memory for a million."""

from __future__ import annotations

from array import array
from collections.abc import Container
from typing import Final

import numpy as np

from ..evaluation.result_columns import ResultColumns
from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import TaskSummary, default_score_range, summarize_task
from ..results.episodes import Episode
from .contents import EpisodeColumns

ROLES: Final = ("best", "median", "worst")

_UNKNOWN: Final = 0
_TERMINATED: Final = 1
_TRUNCATED: Final = 2
_FAILED: Final = 4

# The end of 1979. Gym 0.21 and 0.22 counted from some moment of their own.
_EARLIEST: Final = 315_532_800.0


class EpisodeRows:
    """Episodes of monitors, one monitor after the other, as they are read."""

    def __init__(self) -> None:
        self._infixes: list[str] = []
        self._wanted: Container[int] = ()
        self._places: dict[tuple[str, int], int] = {}
        self._run = array("q")
        self._episode = array("q")
        self._total_reward = array("d")
        self._length = array("q")
        self._end_time = array("d")
        self._outcome = array("B")
        self._success = array("b")

    def __len__(self) -> int:
        return len(self._run)

    @property
    def run_count(self) -> int:
        """Of how many monitors there are episodes."""
        return len(set(self._run))

    def begin(self, infix: str, wanted: Container[int]) -> None:
        """Go on with the next monitor.

        Args:
            infix: the monitor's.
            wanted: the numbers of episodes whose place is to be known, such as those
                that have a video.
        """
        self._infixes.append(infix)
        self._wanted = wanted

    def add(self, episode: Episode) -> None:
        """Add an episode of the monitor that was begun last."""
        number = episode.episode_id
        # One whose number is not certain has none of these, and gets no video.
        files = episode.video or episode.metadata or episode.trajectory
        if files and number in self._wanted:
            self._places[episode.monitor, number] = len(self._run)
        self._run.append(len(self._infixes) - 1)
        self._episode.append(number)
        self._total_reward.append(episode.reward)
        self._length.append(episode.length)
        self._end_time.append(episode.end_time)
        self._outcome.append(
            _TERMINATED * bool(episode.terminated)
            + _TRUNCATED * bool(episode.truncated)
        )
        self._success.append(-1 if episode.success is None else episode.success)

    def columns(self) -> tuple[EpisodeColumns, dict[tuple[str, int], int]]:
        """Return the episodes in the order of their ends, and where some have come.

        Episodes that ended at the same time stay in the order of the monitors; those
        without a time come last.
        """
        end_time = np.array(self._end_time, np.float64)
        order = np.argsort(end_time, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        end_time = end_time[order]
        end_time[end_time < _EARLIEST] = np.nan
        columns = EpisodeColumns(
            run=np.array(self._run, np.int64)[order],
            runs=self._infixes,
            episode=np.array(self._episode, np.int64)[order],
            total_reward=np.array(self._total_reward, np.float64)[order],
            length=np.array(self._length, np.int64)[order],
            end_time=end_time,
            outcome=np.array(self._outcome, np.uint8)[order],
            success=np.array(self._success, np.int8)[order],
        )
        return columns, {key: int(place[row]) for key, row in self._places.items()}


def columns_of_results(results: ResultColumns) -> EpisodeColumns:
    """Return the episodes of one task of an evaluation, in the order of its plan."""
    outcome = (
        _TERMINATED * (results.terminated == 1) + _TRUNCATED * (results.truncated == 1)
    ).astype(np.uint8)
    outcome[results.failed] = _FAILED
    return EpisodeColumns(
        run=results.seed,
        runs=None,
        episode=results.episode,
        total_reward=results.total_reward,
        length=results.length,
        end_time=results.start_time + results.seconds,
        outcome=outcome,
        success=results.success,
        failures=dict(results.failures),
    )


def summary_of_columns(
    name: str, columns: EpisodeColumns, *, runs: int, bootstrap: Bootstrap
) -> TaskSummary:
    """Return what is said of the episodes of monitors.

    Args:
        name: of the environment.
        columns: none of them failed.
        runs: of how many monitors they are.
        bootstrap: how intervals are made.
    """
    outcome, success = columns.outcome, columns.success
    return summarize_task(
        name,
        total_rewards=columns.total_reward,
        runs=runs,
        lengths=columns.length,
        terminated=outcome & _TERMINATED,
        truncated=outcome & _TRUNCATED,
        success=np.where(success < 0, np.nan, success),
        score_range=default_score_range(name),
        bootstrap=bootstrap,
    )


def what_disagrees(summary: TaskSummary, columns: EpisodeColumns) -> list[str]:
    """Return what a summary says of these episodes that is not so, in words.

    Means may differ by what another order of summing makes of them.
    """
    completed = columns.outcome != _FAILED
    returns = columns.total_reward[completed]
    finite = np.isfinite(returns)
    told: list[tuple[str, float | None, float]] = [
        ("the number of episodes", summary.episodes, len(returns)),
        ("how many failed", summary.failed, int(np.count_nonzero(~completed))),
        ("how many returns are finite", summary.not_finite, int((~finite).sum())),
    ]
    has_figures = len(returns) > 0 and bool(finite.all())
    if has_figures:
        told += [
            ("the smallest return", summary.minimum, float(returns.min())),
            ("the largest return", summary.maximum, float(returns.max())),
        ]
    differing = [what for what, said, there in told if said != there]
    # There is no mean where the sum is too large for a number.
    if has_figures and summary.mean is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            mean = float(returns.mean())
        if abs(mean - summary.mean) > 1e-9 * float(np.abs(returns).max()):
            differing.append("the mean return")
    return differing


def episodes_with_roles(columns: EpisodeColumns) -> dict[int, tuple[str, ...]]:
    """Return which episode is the best, the median, and the worst, by index.

    Of equal returns the earlier one counts; the median of an even number is the lower
    one; a return that is not a number is the worst. Failed episodes are none of them.
    """
    completed = np.flatnonzero(columns.outcome != _FAILED)
    if not len(completed):
        return {}
    # What is no number comes first of all.
    returns = columns.total_reward[completed]
    is_number = ~np.isnan(returns)
    values = np.where(is_number, returns, 0.0)
    ordered = np.lexsort((values, is_number))
    middle = ordered[(len(ordered) - 1) // 2]
    chosen = (ordered[-1], middle, ordered[0])
    roles: dict[int, list[str]] = {}
    for role, one in zip(ROLES, chosen, strict=True):
        alike = (values == values[one]) & (is_number == is_number[one])
        roles.setdefault(int(completed[np.argmax(alike)]), []).append(role)
    return {index: tuple(names) for index, names in roles.items()}

# SPDX-License-Identifier: Apache-2.0
"""Episodes as rows of numbers, from monitors and from evaluations."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..evaluation.result_tables import TaskResults
from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import TaskSummary, default_score_range, summarize_task
from ..results.episodes import Episode
from .contents import EPISODE, FAILED, TERMINATED, TRUNCATED

ROLES: Final = ("best", "median", "worst")

# The end of 1979. gym 0.21 and 0.22 counted seconds from an arbitrary moment.
_EARLIEST: Final = 315_532_800.0


def rows_of_monitor(
    episodes: Iterable[Episode], *, run: int, wanted: Container[int | None]
) -> tuple[NDArray[np.void], dict[int, int]]:
    """Return a monitor's episodes as rows, and the row indices of some of them.

    Args:
        episodes: the episodes, which are read one at a time and not kept.
        run: the monitor's index.
        wanted: numbers of the episodes whose indices are returned.
    """
    places: dict[int, int] = {}

    def row(index: int, episode: Episode) -> tuple[float | None, ...]:
        number = episode.episode_id
        # An episode whose number is uncertain has no files, and gets no video.
        files = episode.video or episode.metadata or episode.trajectory
        if files and number in wanted:
            places[number] = index
        outcome = TERMINATED * bool(episode.terminated)
        outcome += TRUNCATED * bool(episode.truncated)
        success = -1 if episode.success is None else episode.success
        reward, length, end = episode.reward, episode.length, episode.end_time
        return run, number, reward, length, end, outcome, success

    rows = (row(index, episode) for index, episode in enumerate(episodes))
    return np.fromiter(rows, EPISODE), places


def in_time(rows: NDArray[np.void]) -> tuple[NDArray[np.void], NDArray[np.intp]]:
    """Return episodes in the order in which they ended, and the new index of each.

    Episodes that ended at the same time keep their order. Those without a time come
    last.
    """
    order = np.argsort(rows["end_time"], kind="stable")
    now_at = np.empty_like(order)
    now_at[order] = np.arange(len(order))
    rows = rows[order]
    rows["end_time"][rows["end_time"] < _EARLIEST] = np.nan
    return rows, now_at


def rows_of_results(results: TaskResults) -> NDArray[np.void]:
    """Return the episodes of one task of an evaluation as rows, in the plan's order."""
    given, rows = results.rows, np.empty(len(results), EPISODE)
    rows["run"] = given["seed"]
    for name in ("episode", "total_reward", "length", "success"):
        rows[name] = given[name]
    rows["end_time"] = given["start_time"] + given["seconds"]
    rows["outcome"] = TERMINATED * (given["terminated"] == 1)
    rows["outcome"] += (TRUNCATED * (given["truncated"] == 1)).astype(np.uint8)
    rows["outcome"][results.failed] = FAILED
    return rows


def summary_of_rows(
    name: str, rows: NDArray[np.void], *, bootstrap: Bootstrap
) -> TaskSummary:
    """Return the summary of the episodes of monitors, none of which failed.

    Args:
        name: the environment's name.
        rows: the episodes.
        bootstrap: settings for the intervals.
    """
    success = rows["success"]
    return summarize_task(
        name,
        total_rewards=rows["total_reward"],
        runs=len(np.unique(rows["run"])),
        lengths=rows["length"],
        terminated=rows["outcome"] & TERMINATED,
        truncated=rows["outcome"] & TRUNCATED,
        success=np.where(success < 0, np.nan, success),
        score_range=default_score_range(name),
        bootstrap=bootstrap,
    )


def episodes_with_roles(rows: NDArray[np.void]) -> dict[int, tuple[str, ...]]:
    """Return the roles of the best, the median and the worst episode, by index.

    Among equal returns, the first episode counts. The median of an even number is the
    lower one. NaN is the worst return. Failed episodes have no role.
    """
    completed = np.flatnonzero(rows["outcome"] != FAILED)
    if not len(completed):
        return {}
    returns = rows["total_reward"][completed]
    is_number = ~np.isnan(returns)
    values = np.where(is_number, returns, 0.0)
    # NaNs come first.
    ordered = np.lexsort((values, is_number))
    middle = ordered[(len(ordered) - 1) // 2]
    roles: dict[int, tuple[str, ...]] = {}
    for role, one in zip(ROLES, (ordered[-1], middle, ordered[0]), strict=True):
        alike = (values == values[one]) & (is_number == is_number[one])
        index = int(completed[np.argmax(alike)])
        roles[index] = (*roles.get(index, ()), role)
    return roles

# SPDX-License-Identifier: Apache-2.0
"""Contents of reports, made by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import summarize_across, summarize_task
from mjrec.reporting.contents import (
    EpisodeColumns,
    ReportContents,
    ReportTask,
    ReportVideo,
)

_FEW = Bootstrap(resamples=50)

# Markup, quotes, what ends a script, a comment and a template, a mark that turns the
# direction of writing, line ends that JSON allows and JavaScript did not, a formula for
# matplotlib, and a name that never ends.
HOSTILE = (
    "<script>alert(1)</script>",
    "</script><script>alert(2)</script>",
    "\"><img src=x onerror=alert(3)>'",
    "<!--<script>",
    "{{ 7 * 7 }} {% raw %}",
    "abc\u202edef\u2028ghi\x00\x1b[31m",
    "$\\frac{1}{0$ &amp; &lt;",
    "javascript:alert(4)",
    "שלום مرحبا",
    "x" * 10_000,
    "a b/" * 2_500,
)


def columns(
    returns: Sequence[float],
    *,
    seeds: int = 1,
    runs: Sequence[str] | None = None,
    failures: Mapping[int, str] | None = None,
    videos: Mapping[int, Sequence[int]] | None = None,
) -> EpisodeColumns:
    """Return episodes of equally many in each run."""
    count = len(returns)
    each = max(1, count // seeds)
    outcome = np.full(count, 2, np.uint8)
    rewards = np.array(returns, np.float64)
    for index in failures or {}:
        outcome[index] = 4
        rewards[index] = np.nan
    return EpisodeColumns(
        run=np.arange(count) // each,
        runs=runs,
        episode=np.arange(count) % each,
        total_reward=rewards,
        length=np.arange(count) % 7 + 10,
        end_time=1.7e9 + np.arange(count),
        outcome=outcome,
        success=np.full(count, -1, np.int8),
        failures=failures or {},
        videos=videos or {},
    )


def task(name: str, episodes: EpisodeColumns, **changes: Any) -> ReportTask:
    """Return a task with those episodes; runs that have names are monitors."""
    known = episodes.total_reward[np.isfinite(episodes.total_reward)]
    summary = summarize_task(
        name,
        total_rewards=known,
        runs=len(np.unique(episodes.run)),
        failed=len(episodes.failures),
        score_range=changes.pop("score_range", (0.0, 1000.0)),
        bootstrap=_FEW,
    )
    made = ReportTask(
        name=name,
        source="evaluation",
        is_evaluation=episodes.runs is None,
        summary=summary,
        episodes=episodes,
        provenance=[("Policy", "random"), ("Selection rule", "best, median and worst")],
    )
    return replace(made, **changes)


def video(task: int = 0, index: int | None = 0, **changes: Any) -> ReportVideo:
    """Return a video, whose file need not be there."""
    made = ReportVideo(
        task=task,
        index=index,
        file="videos/a b.mp4",
        poster="videos/a b.png",
        name="a b.mp4",
        roles=("best",),
        height=48,
        width=64,
        seconds=2.0,
        camera="side",
        sha256="0123456789abcdef" * 4,
        command="mjrec render evaluation/walker --episode 3 -o again.mp4",
    )
    return replace(made, **changes)


def contents(*tasks: ReportTask, **changes: Any) -> ReportContents:
    """Return a report of them, or of two tasks of five seeds."""
    if not tasks:
        tasks = (
            task("dm_control/walker-walk", columns(_returns(900, 40), seeds=5)),
            task("dm_control/cheetah-run", columns(_returns(600, 100), seeds=5)),
        )
    scores = {t.name: t.episodes.total_reward / 1000 for t in tasks}
    finite = all(np.isfinite(s).all() and len(s) for s in scores.values())
    across = {"evaluation": summarize_across(scores, bootstrap=_FEW)} if finite else {}
    made = ReportContents(
        title="An evaluation", tasks=tasks, across=across, bootstrap=_FEW
    )
    return replace(made, **changes)


def _returns(mean: float, spread: float) -> list[float]:
    values: list[float] = np.random.default_rng(0).normal(mean, spread, 50).tolist()
    return values

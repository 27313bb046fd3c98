# SPDX-License-Identifier: Apache-2.0
"""Evaluations that were never run: their files, from returns by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.evaluation import write_results
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import default_score_range, summarize_results


def write_evaluation(
    directory: Path,
    returns: Mapping[str, Sequence[Sequence[float | None]]],
    *,
    score_ranges: Mapping[str, tuple[float, float]] | None = None,
    versions: Mapping[str, str] | None = None,
    **plan: Any,
) -> Path:
    """Write the results of an evaluation, and return its directory.

    Args:
        directory: is made.
        returns: for each task and seed those of its episodes; None is a failed one.
        score_ranges: of tasks that have none of their own.
        versions: of what ran.
        plan: further fields of the plan.
    """
    runs = max(map(len, returns.values()))
    asked = EvaluationPlan(
        **{
            "tasks": tuple(
                EvaluatedTask(task, f"task{number}")
                for number, task in enumerate(returns)
            ),
            "policy": "random",
            "seeds": tuple(range(runs)),
            "episodes": len(next(iter(returns.values()))[0]),
            **plan,
        }
    )
    results = {
        task: [
            _result(task, seed, number, total)
            for seed, totals in zip(asked.seeds, by_seed, strict=True)
            for number, total in enumerate(totals)
        ]
        for task, by_seed in returns.items()
    }
    ranges = score_ranges or {}
    directory.mkdir(parents=True)
    write_results(
        directory,
        plan=asked,
        results=[result for each in results.values() for result in each],
        summaries=[
            summarize_results(
                task,
                each,
                score_range=ranges.get(
                    task, default_score_range(task, asked.max_steps)
                ),
                bootstrap=Bootstrap(resamples=10),
            )
            for task, each in results.items()
        ],
        across=None,
        bootstrap=Bootstrap(resamples=10),
        selection={},
        versions=versions or {},
    )
    return directory


def _result(task: str, seed: int, number: int, total: float | None) -> EpisodeResult:
    has_failed = total is None
    return EpisodeResult(
        task=task,
        seed=seed,
        episode=number,
        total_reward=total,
        length=10,
        terminated=None if has_failed else False,
        truncated=None if has_failed else True,
        failure="it raised" if has_failed else None,
    )

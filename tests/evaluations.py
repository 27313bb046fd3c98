# SPDX-License-Identifier: Apache-2.0
"""Files of evaluations, written from given returns without running anything."""

import re

from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.evaluation import ChosenEpisode, Evaluation, write_results
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.result_tables import EpisodeFiles
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import (
    AcrossTasks,
    default_score_range,
    summarize_results,
)
from mjrec.formats.json_fields import to_json
from mjrec.json_text import dumps
from report_recordings import entry, write_journal


def write_evaluation(
    directory,
    returns,
    *,
    score_ranges=None,
    across=None,
    bootstrap=Bootstrap(resamples=10),  # noqa: B008  immutable
    versions=None,
    monitor=None,
    videos=None,
    finished=True,
    **plan,
):
    """Write the results of an evaluation, and return its directory.

    `returns` has the return of each task, seed and episode, None for a failed episode.
    With `monitor`, an infix, each task has a journal. `videos` names the video of each
    task's first episode. `plan` has further fields of the plan.
    """
    folders = {task: re.sub(r"[^\w.-]", "-", task) for task in returns}
    planned = EvaluationPlan(
        **{
            "tasks": tuple(EvaluatedTask(*each) for each in folders.items()),
            "policy": "random",
            "seeds": tuple(range(max(map(len, returns.values())))),
            "episodes": len(next(iter(returns.values()))[0]),
            **plan,
        }
    )
    results = {
        task: [
            _result(task, seed, number, total, monitor, index * len(totals) + number)
            for index, (seed, totals) in enumerate(
                zip(planned.seeds, by_seed, strict=True)
            )
            for number, total in enumerate(totals)
        ]
        for task, by_seed in returns.items()
    }
    directory.mkdir(parents=True, exist_ok=True)
    for task, rows in results.items() if monitor else ():
        entries = [_entry(each) for each in rows if each.total_reward is not None]
        write_journal(directory / folders[task], monitor, task, entries)
    if not finished:
        content = {"format_version": 1, "plan": to_json(planned)}
        (directory / "evaluation.json").write_text(dumps(content))
        return directory
    ranges, videos = score_ranges or {}, videos or {}

    def scale(task):
        return ranges.get(task, default_score_range(task, planned.max_steps))

    def files(result):
        is_first = result is results[result.task][0]
        video = videos.get(result.task) if is_first else None
        return EpisodeFiles(folders[result.task] if monitor else None, video=video)

    evaluation = Evaluation(
        directory=directory,
        plan=planned,
        summaries=[
            summarize_results(task, each, score_range=scale(task), bootstrap=bootstrap)
            for task, each in results.items()
        ],
        across=across,
        bootstrap=bootstrap,
        selection={
            task: [ChosenEpisode(planned.seeds[0], 0, "best")] for task in videos
        },
        versions=versions or {},
    )
    write_results(evaluation, [r for each in results.values() for r in each], files)
    return directory


def _entry(result):
    unit = {"seed": result.seed, "episode": result.episode}
    reward = result.total_reward
    return entry(result.episode_id, reward=reward, seed=result.seed, evaluation=unit)


def _result(task, seed, number, total, monitor, episode_id):
    has_failed = total is None
    recorded = {
        "success": None if has_failed else episode_id == 0,
        "monitor": monitor,
        "episode_id": episode_id,
        "start_time": 1.79e9 + episode_id,
        "seconds": 1.0,
    }
    return EpisodeResult(
        task=task,
        seed=seed,
        episode=number,
        total_reward=total,
        length=10,
        terminated=None if has_failed else False,
        truncated=None if has_failed else True,
        failure="PolicyError: it gave <b>NaN</b>" if has_failed else None,
        **(recorded if monitor else {}),
    )


def write_recorded(directory, tasks, *, rewards=(3.0, 1.0, None, 2.0), **options):
    """Write an evaluation of two seeds with the journals of its monitors."""
    half = len(rewards) // 2
    returns = {task: [rewards[:half], rewards[half:]] for task in tasks}
    return write_evaluation(
        directory,
        returns,
        **{"seeds": (0, 7), "monitor": "0.batch", **options},
        bootstrap=Bootstrap(resamples=100, seed=3),
        across=AcrossTasks(tasks=(), left_out=dict.fromkeys(tasks, "no scale")),
        versions={"mjrec": "9.9", "mujoco": "8.8"},
    )

# SPDX-License-Identifier: Apache-2.0
"""Small recordings that reports are made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import mjrec
from mjrec.evaluation.dataclass_json import to_json
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.evaluation import ChosenEpisode, write_results
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.result_tables import EpisodeFiles
from mjrec.evaluation.statistics import Bootstrap
from mjrec.evaluation.summaries import AcrossTasks, summarize_results
from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.json_text import dumps

GYM = Path(__file__).parent / "data" / "gym"


def entry(episode_id: int, **values: Any) -> JournalEntry:
    known: dict[str, Any] = {
        "episode_id": episode_id,
        "length": 10,
        "reward": float(episode_id),
        "type": "t",
        "start_time": 1.79e9 + episode_id,
        "end_time": 1.79e9 + episode_id + 0.5,
        "seed": None,
        "options": None,
        "terminated": False,
        "truncated": True,
        "success": None,
    }
    return JournalEntry(**{**known, **values})


def write_journal(
    directory: Path, infix: str, env_id: str, entries: Sequence[JournalEntry]
) -> Path:
    """Write what a monitor that was killed leaves."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"openaigym.episodes.{infix}.jsonl"
    info = {"gym_version": "mjrec-1", "env_id": env_id}
    writer = JournalWriter(path, run={"env_info": info})
    for each in entries:
        writer.append(each)
    writer.close()
    return path


def record(env: Any, directory: Path, episodes: int, **options: Any) -> None:
    """Record episodes of a fixed action."""
    monitor = mjrec.Monitor(env, directory, **options)
    for seed in range(episodes):
        monitor.reset(seed=seed)
        done = False
        while not done:
            action = np.zeros_like(monitor.action_space.sample())
            _, _, terminated, truncated, _ = monitor.step(action)
            done = terminated or truncated
    monitor.close()


def write_evaluation(
    directory: Path,
    tasks: Sequence[str],
    *,
    rewards: Sequence[float | None] = (3.0, 1.0, None, 2.0),
    videos: dict[str, str] | None = None,
    infix: str = "0.batch",
    finished: bool = True,
) -> None:
    """Write an evaluation of two seeds; each task's monitor has one journal.

    Args:
        directory: of the evaluation.
        tasks: names; their folders are called likewise.
        rewards: of each task's episodes, None where it failed.
        videos: by task, the video of its first episode.
        infix: of the monitors.
        finished: whether there are results.
    """
    plan = EvaluationPlan(
        tasks=tuple(EvaluatedTask(name, name.replace("/", "-")) for name in tasks),
        policy="random",
        seeds=(0, 7),
        episodes=len(rewards) // 2,
    )
    units = [(seed, i) for seed in plan.seeds for i in range(plan.episodes)]
    results = []
    for task in plan.tasks:
        for number, ((seed, episode), reward) in enumerate(
            zip(units, rewards, strict=True)
        ):
            failed = reward is None
            results.append(
                EpisodeResult(
                    task=task.name,
                    seed=seed,
                    episode=episode,
                    total_reward=reward,
                    length=10,
                    terminated=None if failed else False,
                    truncated=None if failed else True,
                    success=None if failed else number == 0,
                    failure="PolicyError: it gave <b>NaN</b>" if failed else None,
                    monitor=infix,
                    episode_id=number,
                    start_time=1.79e9 + number,
                    seconds=1.0,
                )
            )
    directory.mkdir(parents=True, exist_ok=True)
    for task in plan.tasks:
        entries = [
            entry(
                r.episode_id or 0,
                reward=r.total_reward,
                seed=r.seed,
                evaluation={"seed": r.seed, "episode": r.episode},
            )
            for r in results
            if r.task == task.name and r.total_reward is not None
        ]
        write_journal(directory / task.folder, infix, task.name, entries)
    if not finished:
        content = {"format_version": 1, "plan": to_json(plan)}
        (directory / "evaluation.json").write_text(dumps(content))
        return
    shown = videos or {}

    def files(result: EpisodeResult) -> EpisodeFiles:
        first = result.unit == units[0] and result.task in shown
        folder = result.task.replace("/", "-")
        return EpisodeFiles(folder, video=shown[result.task] if first else None)

    write_results(
        directory,
        plan=plan,
        results=results,
        summaries=[
            summarize_results(task, [r for r in results if r.task == task])
            for task in tasks
        ],
        across=AcrossTasks(tasks=(), left_out=dict.fromkeys(tasks, "no scale")),
        bootstrap=Bootstrap(resamples=100, seed=3),
        selection={task: [ChosenEpisode(0, 0, "best")] for task in shown},
        versions={"mjrec": "9.9", "mujoco": "8.8"},
        files=files,
    )

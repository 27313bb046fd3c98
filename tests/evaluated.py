# SPDX-License-Identifier: Apache-2.0
"""Small evaluations for tests: their plans, workers and jobs, in this process."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recordings import in_flight

from mjrec.engines.worker import AGAIN
from mjrec.evaluation.dataclass_json import to_json
from mjrec.evaluation.plan import EvaluatedTask, EvaluationPlan
from mjrec.evaluation.worker import EvaluationWorker
from mjrec.formats.trajectory_file import open_trajectory

PENDULUM = "InvertedPendulum-v5"
FOLDER = "task"


def plan_of(task: str = PENDULUM, **changes: Any) -> EvaluationPlan:
    """Return a plan for one task, with short episodes and small pictures."""
    options: dict[str, Any] = {
        "policy": "random",
        "seeds": (0, 1),
        "episodes": 3,
        "max_steps": 8,
        "height": 32,
        "width": 32,
    }
    tasks = (EvaluatedTask(task, FOLDER),)
    return EvaluationPlan(tasks=tasks, **{**options, **changes})


def worker_of(
    directory: Path, plan: EvaluationPlan, payload: bytes | None = None
) -> EvaluationWorker:
    """Return a worker of an evaluation, given its plan as it travels."""
    values = json.loads(json.dumps(to_json(plan)))
    return EvaluationWorker({"directory": str(directory), "plan": values}, payload)


def run_job(
    plan: EvaluationPlan, seed: int, *episodes: int, again: bool = False
) -> dict[str, Any]:
    """Return the job of a batch; of all episodes of the plan, if none is named."""
    return {
        AGAIN: again,
        "kind": "run",
        "task": plan.tasks[0].name,
        "folder": FOLDER,
        "seed": seed,
        "episodes": list(episodes or range(plan.episodes)),
    }


def facts_of(path: Path) -> Mapping[str, Any]:
    """Return what a trajectory says of its episode."""
    with open_trajectory(path) as reader:
        return dict(reader.facts)


def states_of(folder: Path, monitor: str | None, episode_id: int | None) -> Any:
    """Return the states of a recorded episode."""
    pattern = f"openaigym.trajectory.{monitor}.episode{episode_id:06d}.h5"
    names = {*folder.glob(pattern), *in_flight(folder)}
    [path] = [name for name in names if name.match(pattern)]
    with open_trajectory(path) as reader:
        return reader.states(0, reader.row_count)

# SPDX-License-Identifier: Apache-2.0
"""Tasks and checks as JSON, on their way to the checking process and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..verification import Check, Level, Verdict
from .task import Task


def check_to_json(check: Check) -> dict[str, Any]:
    """Return a check as JSON knows it."""
    return {
        "level": check.level.value,
        "claim": check.claim,
        "subject": check.subject,
        "verdict": check.verdict.value,
        "reason": check.reason,
        "figures": dict(check.figures),
    }


def check_from_json(said: Mapping[str, Any]) -> Check:
    """Return the check that `check_to_json` was given."""
    return Check(
        level=Level(said["level"]),
        claim=said["claim"],
        subject=said["subject"],
        verdict=Verdict(said["verdict"]),
        reason=said["reason"],
        figures=said["figures"],
    )


def task_to_json(task: Task) -> dict[str, Any]:
    """Return a task as JSON knows it."""
    return {
        "recordings": str(task.recordings),
        "level": task.level.value,
        "sample": task.sample,
        "seed": task.seed,
        "trust": sorted(task.trust),
        "environment": dict(task.environment),
        "pictures": None if task.pictures is None else str(task.pictures),
    }


def task_from_json(said: Mapping[str, Any]) -> Task:
    """Return the task that `task_to_json` was given."""
    pictures = said["pictures"]
    return Task(
        recordings=Path(said["recordings"]),
        level=Level(said["level"]),
        sample=said["sample"],
        seed=said["seed"],
        trust=frozenset(said["trust"]),
        environment=said["environment"],
        pictures=None if pictures is None else Path(pictures),
    )

# SPDX-License-Identifier: Apache-2.0
"""A plan as JSON: in `evaluation.json`, and on its way to the workers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..formats.json_fields import (
    base_name,
    boolean,
    field,
    integer,
    list_of,
    mapping,
    number,
    optional,
    text,
)
from .plan import SEEDED, SUITE, EvaluatedTask, EvaluationPlan, Protocol

_QUALITIES = ("full", "draft")


def plan_to_json(plan: EvaluationPlan) -> dict[str, Any]:
    """Return a plan as a JSON object, with the names of its attributes."""
    fields = dataclasses.fields(plan)
    values = {each.name: getattr(plan, each.name) for each in fields}
    return {
        **values,
        "tasks": [{"name": t.name, "folder": t.folder} for t in plan.tasks],
        "seeds": list(plan.seeds),
        "env_kwargs": dict(plan.env_kwargs),
    }


def plan_from_json(values: Mapping[str, Any]) -> EvaluationPlan:
    """Return the plan that a JSON object is of. Keys that nobody knows are ignored.

    What a plan means (whether there are such tasks, such a rule) is not checked here.

    Raises:
        ValueError: something is missing, or is not what it should be.
    """
    return EvaluationPlan(
        tasks=field(values, "tasks", list_of(_task)),
        policy=field(values, "policy", text),
        is_object=field(values, "is_object", boolean, default=False),
        seeds=field(values, "seeds", list_of(integer)),
        episodes=field(values, "episodes", _positive),
        protocol=field(values, "protocol", _protocol),
        keep=field(values, "keep", text),
        max_steps=field(values, "max_steps", optional(_positive)),
        camera=field(values, "camera", optional(_camera)),
        height=field(values, "height", optional(_positive)),
        width=field(values, "width", optional(_positive)),
        max_fps=field(values, "max_fps", optional(number)),
        quality=field(values, "quality", _quality),
        env_kwargs=field(values, "env_kwargs", mapping),
    )


def _task(value: Any) -> EvaluatedTask:
    values = mapping(value)
    return EvaluatedTask(
        name=field(values, "name", text), folder=field(values, "folder", base_name)
    )


def _protocol(value: Any) -> Protocol:
    if value == SEEDED:
        return SEEDED
    if value == SUITE:
        return SUITE
    raise ValueError(f"{value!r:.80} is no protocol: there are {SEEDED} and {SUITE}")


def _quality(value: Any) -> str:
    if value not in _QUALITIES:
        raise ValueError(f"{value!r:.80} is no quality: there are full and draft")
    return str(value)


def _camera(value: Any) -> str | int:
    return integer(value) if isinstance(value, int | float) else text(value)


def _positive(value: Any) -> int:
    count = integer(value)
    if count < 1:
        raise ValueError(f"{count} is not 1 or more")
    return count

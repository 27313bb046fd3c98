# SPDX-License-Identifier: Apache-2.0
"""What is to be evaluated, and the pieces that it is handed out in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

from ..formats.json_fields import base_name, one_of, positive
from ..frames import QUALITIES

Protocol: TypeAlias = Literal["seeded", "suite"]
SEEDED: Protocol = "seeded"
SUITE: Protocol = "suite"

_Positive: TypeAlias = Annotated[int, positive]


@dataclass(frozen=True)
class EvaluatedTask:
    """An environment that a policy is evaluated in.

    Attributes:
        name: as `environments.names.parse_environment_name` takes it.
        folder: the base name of its monitor directory, inside that of the evaluation.
    """

    name: str
    folder: Annotated[str, base_name]


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """What is to be evaluated, checked. It stands in `evaluation.json`.

    What it means (whether there are such tasks, such a rule) is not checked when it is
    read back.

    Attributes:
        tasks: in the order of the results.
        policy: `random`, `zero`, `module:name`, or what an object is called whose
            bytes travel beside the plan (`is_object`).
        is_object: whether the policy is such an object.
        seeds: in the order of the results.
        episodes: of each task and seed.
        protocol: `"seeded"`: episode i of seed s starts from `SeedSequence([s, i])`.
            `"suite"`: the environment has one random stream for each task and seed.
        keep: which episodes get a video, as `evaluation.kept_episodes` reads it.
        max_steps: ends an episode as truncated; None is the environment's own limit,
            and 1000 where it has none.
        camera: of the videos; None is the model's tracking camera where there is one.
        height: of the videos; None is the environment's own.
        width: likewise.
        max_fps: the most frames per second of simulated time; None is every step.
        quality: `"full"` or `"draft"`.
        env_kwargs: more arguments for each environment.
    """

    tasks: tuple[EvaluatedTask, ...]
    policy: str
    is_object: bool = False
    seeds: tuple[int, ...]
    episodes: _Positive
    protocol: Protocol = SEEDED
    keep: str = "best,median,worst"
    max_steps: _Positive | None = None
    camera: str | int | None = None
    height: _Positive | None = None
    width: _Positive | None = None
    max_fps: float | None = 60
    quality: Annotated[str, one_of(*QUALITIES)] = "full"
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Episodes of one task and seed that one worker runs, one after the other.

    With the protocol `"suite"` it is all episodes of the task and seed, and done as a
    whole or not at all; else any of them, each done by itself.

    Attributes:
        task: its name.
        folder: its monitor directory's base name.
        seed: of the run.
        episodes: their numbers, rising.
    """

    task: str
    folder: str
    seed: int
    episodes: tuple[int, ...]

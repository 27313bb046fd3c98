# SPDX-License-Identifier: Apache-2.0
"""The plan of an evaluation, its chunks, and the file `evaluation.json`.

The file is written before any episode runs.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from ..atomic_files import write_text
from ..errors import DifferentEvaluation
from ..formats import json_fields
from ..formats.json_fields import (
    base_name,
    from_json,
    one_of,
    positive,
    to_json,
    unreadable,
)
from ..frames import QUALITIES
from ..json_text import dumps

FORMAT_VERSION = 1
PLAN_NAME = "evaluation.json"

# The warning to log if videos cannot be drawn, followed by the reason.
NO_GL = (
    "Videos cannot be drawn on this machine, so the chosen videos will stay pending "
    "(use --keep none to choose no videos): %s"
)

Protocol: TypeAlias = Literal["seeded", "suite"]
SEEDED: Protocol = "seeded"
SUITE: Protocol = "suite"

Unit: TypeAlias = tuple[int, int]
"""The seed and episode number, which identify an episode within its task."""

# Fields that may have changed when an evaluation is resumed.
_MAY_DIFFER = ("tasks", "chunks", "episode_timeout", "score_ranges", "confidence")

_Positive: TypeAlias = Annotated[int, positive]


@dataclass(frozen=True)
class EvaluatedTask:
    """An environment in which the policy is evaluated.

    Attributes:
        name: the environment's name; see `environments.names.parse_environment_name`.
        folder: base name of the task's folder in the evaluation's directory.
        step_limit: maximum number of steps per episode; None until the environment has
            been created.
    """

    name: str
    folder: Annotated[str, base_name]
    step_limit: _Positive | None = None


@dataclass(frozen=True)
class Chunk:
    """Episodes of one task that a single job runs and records in one monitor directory.

    Attributes:
        folder: base name of the monitor directory in the folder of each task.
        seeds: seeds of the episodes, in ascending order.
        first: number of the first episode of each seed.
        stop: one more than the number of the last episode of each seed.
    """

    folder: Annotated[str, base_name]
    seeds: tuple[int, ...]
    first: int
    stop: int

    def __iter__(self) -> Iterator[Unit]:
        """Yield the episodes in the order in which they run."""
        for seed in self.seeds:
            for number in range(self.first, self.stop):
                yield seed, number

    def __len__(self) -> int:
        return len(self.seeds) * (self.stop - self.first)


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """The checked plan of an evaluation, stored in `evaluation.json`.

    When the file is read, types and ranges are checked, but the existence of the tasks
    and the rule is not.

    Attributes:
        tasks: the tasks, in the order of the results.
        policy: a string as in `mjrec record`, or the name of an object that is sent
            separately (see `is_object`).
        is_object: whether the policy is an object.
        policy_kwargs: keyword arguments for the policy.
        policy_digests: SHA-256 of each part of the policy, keyed by a description of
            the part.
        sources: SHA-256 of other sources of the results, keyed by a description of
            each: the user's modules that workers imported (not those of installed
            packages), and the compiled models of MJCF files.
        seeds: the seeds, in the order of the results.
        episodes: number of episodes per task and seed.
        protocol: `"seeded"`: episode i of seed s starts from `SeedSequence([s, i])`.
            `"suite"`: the episodes of a task and seed share one random stream.
        chunks: the chunks into which the episodes of each task are divided.
        keep: rule that chooses the episodes for videos; see `recorder.keep_rules`.
        max_steps: number of steps after which an episode is truncated; None for the
            environment's own limit, or 1000 steps if it has no limit.
        episode_timeout: timeout for an episode, in seconds; None for no timeout.
        camera: the camera for the videos; None for the model's tracking camera, if
            there is one.
        height: height of the videos; None for the environment's default.
        width: width of the videos; None for the environment's default.
        max_fps: maximum number of frames per second of simulated time; None for one
            frame per step.
        quality: `"full"` or `"draft"`.
        env_kwargs: keyword arguments for each environment.
        score_ranges: the given returns for scores of 0 and 1, by task.
        confidence: confidence level of the intervals.
    """

    tasks: tuple[EvaluatedTask, ...]
    policy: str
    is_object: bool = False
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)
    policy_digests: Mapping[str, str] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    seeds: tuple[int, ...]
    episodes: _Positive
    protocol: Protocol = SEEDED
    chunks: tuple[Chunk, ...] = ()
    keep: str = "best,median,worst"
    max_steps: _Positive | None = None
    episode_timeout: float | None = None
    camera: str | int | None = None
    height: _Positive | None = None
    width: _Positive | None = None
    max_fps: float | None = 60
    quality: Annotated[str, one_of(*QUALITIES)] = "full"
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    score_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    confidence: float = 0.95

    @property
    def policy_and_kwargs(self) -> str:
        """The policy and its keyword arguments, as human-readable text."""
        return ", ".join([self.policy, *kwargs_as_text(self.policy_kwargs)])

    def __iter__(self) -> Iterator[Unit]:
        """Yield the episodes of a task in the order of the results."""
        for seed in self.seeds:
            for number in range(self.episodes):
                yield seed, number


def kwargs_as_text(kwargs: Mapping[str, Any]) -> list[str]:
    """Return keyword arguments as written in a call."""
    return [f"{name}={value!r}" for name, value in kwargs.items()]


def write_plan(directory: Path, plan: EvaluationPlan) -> None:
    """Write the plan to an evaluation's directory.

    Raises:
        FileNotWritten: the disk is full, or the directory is missing or read-only.
    """
    write_versioned(directory / PLAN_NAME, {"plan": to_json(plan)})


def read_plan(directory: Path) -> EvaluationPlan:
    """Read the plan of the evaluation in a directory.

    Raises:
        UnreadableFile: the plan is missing, damaged or of a different format version.
    """
    path = directory / PLAN_NAME
    with unreadable(path):
        read_as_plan = functools.partial(from_json, EvaluationPlan)
        return json_fields.field(read_versioned(path), "plan", read_as_plan)


def write_versioned(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object together with the format version."""
    content = {"format_version": FORMAT_VERSION, **value}
    write_text(path, dumps(content, indent=2) + "\n")


def read_versioned(path: Path) -> Mapping[str, Any]:
    """Read the JSON object in a file, and check its format version.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file does not contain a JSON object in this format version.
    """
    value = json_fields.read_object(path)
    version = json_fields.field(value, "format_version", json_fields.integer)
    if version != FORMAT_VERSION:
        raise ValueError(
            f"it has format version {version}, but this mjrec reads version "
            f"{FORMAT_VERSION}"
        )
    return value


def check_continues(
    directory: Path, begun: EvaluationPlan, asked: EvaluationPlan
) -> None:
    """Check that a new plan can continue an existing evaluation.

    The new plan may have different tasks, additional seeds and more episodes. With the
    protocol `"suite"`, it must not have more episodes, because all episodes of a seed
    form one unit of work. Any other difference would change results or videos. Episodes
    must not be dropped, because the user may already have seen their returns.

    Args:
        directory: the evaluation's directory, for the error message.
        begun: the plan of the existing evaluation.
        asked: the new plan.

    Raises:
        DifferentEvaluation: the new plan cannot continue the evaluation.
    """
    was, now = to_json(begun), to_json(asked)
    for plan in (was, now):
        plan["policy"] = "an object" if plan.pop("is_object") else plan["policy"]
        for part, digest in plan.pop("policy_digests").items():
            plan[f"policy ({part})"] = f"{digest[:12]}..."
        sources = plan.pop("sources")
        # Added tasks may have more sources.
        plan |= {name: f"{sources[name][:12]}..." for name in begun.sources}
    may_differ = [*_MAY_DIFFER]
    if set(begun.seeds) <= set(asked.seeds):
        may_differ.append("seeds")
    if asked.protocol != SUITE and asked.episodes > begun.episodes:
        may_differ.append("episodes")
    differences = {
        name: (was.get(name), now.get(name))
        for name in was | now
        if was.get(name) != now.get(name) and name not in may_differ
    }
    if differences:
        raise DifferentEvaluation(directory, differences)

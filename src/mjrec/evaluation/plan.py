# SPDX-License-Identifier: Apache-2.0
"""What is evaluated, in which chunks, and `evaluation.json`, which says so.

That file is written before anything is run.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from ..atomic_files import write_text
from ..errors import DifferentEvaluation, UnreadableFile
from ..formats import json_fields
from ..formats.dataclass_json import from_json, to_json
from ..formats.json_fields import base_name, one_of, positive, unreadable
from ..frames import QUALITIES
from ..json_text import dumps

FORMAT_VERSION = 1
PLAN_NAME = "evaluation.json"

# What is logged, with the reason, where no video can be drawn.
NO_GL = (
    "No video can be drawn here, and those that are chosen will stay pending "
    "(--keep none wants none): %s"
)

Protocol: TypeAlias = Literal["seeded", "suite"]
SEEDED: Protocol = "seeded"
SUITE: Protocol = "suite"

Unit: TypeAlias = tuple[int, int]
"""Seed and number, which tell an episode from the others of its task."""

# What may be asked for anew, and what follows from it or changes no result.
_MAY_DIFFER = ("tasks", "chunks", "episode_timeout")

_Positive: TypeAlias = Annotated[int, positive]


@dataclass(frozen=True)
class EvaluatedTask:
    """An environment that a policy is evaluated in.

    Attributes:
        name: as `environments.names.parse_environment_name` takes it.
        folder: the base name of its folder in the evaluation's directory.
        step_limit: after how many steps its episodes end; None where it was not made.
    """

    name: str
    folder: Annotated[str, base_name]
    step_limit: _Positive | None = None


@dataclass(frozen=True)
class Chunk:
    """Episodes that one job runs, into a monitor directory of their own.

    Attributes:
        folder: the base name of that directory, in the folder of each task.
        seeds: of the episodes, rising.
        first: the number of each seed's first episode.
        stop: the number after its last.
    """

    folder: Annotated[str, base_name]
    seeds: tuple[int, ...]
    first: int
    stop: int

    def __iter__(self) -> Iterator[Unit]:
        """Yield the episodes in the order in which they are run."""
        for seed in self.seeds:
            for number in range(self.first, self.stop):
                yield seed, number

    def __len__(self) -> int:
        return len(self.seeds) * (self.stop - self.first)


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """What is evaluated, checked. It stands in `evaluation.json`.

    What it means (whether there are such tasks, such a rule) is not checked when it is
    read back.

    Attributes:
        tasks: in the order of the results.
        policy: a text as in `mjrec record`, or what an object is called whose bytes
            travel beside the plan (`is_object`).
        is_object: whether the policy is such an object.
        policy_kwargs: more arguments for it.
        policy_digests: SHA-256 of the policy's parts, by what they are.
        seeds: in the order of the results.
        episodes: of each task and seed.
        protocol: `"seeded"`: episode i of seed s starts from `SeedSequence([s, i])`.
            `"suite"`: the environment has one random stream for each task and seed.
        chunks: in which the episodes of each task are run.
        keep: which episodes get a video, see `recorder.keep_rules`.
        max_steps: ends an episode as truncated; None is the environment's own limit,
            and 1000 where it has none.
        episode_timeout: seconds after which an episode has failed; None is never.
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
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)
    policy_digests: Mapping[str, str] = field(default_factory=dict)
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

    def chunk_of(self, unit: Unit) -> Chunk | None:
        """Return the chunk that an episode is in."""
        seed, number = unit
        chunks = self._chunks_by_seed.get(seed, ())
        return next((each for each in chunks if each.first <= number < each.stop), None)

    @functools.cached_property
    def _chunks_by_seed(self) -> Mapping[int, list[Chunk]]:
        chunks: dict[int, list[Chunk]] = {}
        for chunk in self.chunks:
            for seed in chunk.seeds:
                chunks.setdefault(seed, []).append(chunk)
        return chunks

    def __iter__(self) -> Iterator[Unit]:
        """Yield the episodes of each task in the order of the results."""
        for seed in self.seeds:
            for number in range(self.episodes):
                yield seed, number


def write_plan(directory: Path, plan: EvaluationPlan) -> None:
    """Write the plan into an evaluation's directory.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone or read-only.
    """
    value = {"format_version": FORMAT_VERSION, "plan": to_json(plan)}
    write_text(directory / PLAN_NAME, dumps(value, indent=2) + "\n")


def read_plan(directory: Path) -> EvaluationPlan:
    """Return the plan of the evaluation in a directory.

    Raises:
        UnreadableFile: it is missing, damaged, or of a newer format.
    """
    path = directory / PLAN_NAME
    with unreadable(path):
        value = json_fields.read_object(path)
        version = json_fields.field(value, "format_version", json_fields.integer)
        if version != FORMAT_VERSION:
            raise UnreadableFile(
                path,
                f"its format is version {version}, and this mjrec reads "
                f"{FORMAT_VERSION}",
            )
        return json_fields.field(
            value, "plan", lambda plan: from_json(EvaluationPlan, plan)
        )


def check_continues(
    directory: Path, begun: EvaluationPlan, asked: EvaluationPlan
) -> None:
    """Check that what is asked for goes on with what was begun.

    Other tasks and more seeds may be asked for, and more episodes; with the protocol
    `"suite"` not those, whose number belongs to the unit of work. All else makes other
    results, or other videos; and those who leave episodes out have seen their returns.

    Raises:
        DifferentEvaluation: it does not.
    """
    was, now = to_json(begun), to_json(asked)
    for plan in (was, now):
        plan["policy"] = "an object" if plan.pop("is_object") else plan["policy"]
        for part, digest in plan.pop("policy_digests").items():
            plan[f"policy ({part})"] = f"{digest[:12]}..."
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

# SPDX-License-Identifier: Apache-2.0
"""From what a person asks for to a plan, checked without making an environment."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..environments.episode_seeds import episode_seeds
from ..environments.named_environment import EnvironmentOptions
from ..environments.names import MjcfName, parse_environment_name
from ..errors import InvalidArgument, UnknownName
from ..frames import check_quality
from ..json_text import loads
from ..rates import to_rate
from .kept_episodes import keep_rule
from .plan import SEEDED, SUITE, EvaluatedTask, EvaluationPlan
from .task_sets import tasks_from

DEFAULT_SEEDS = 5

_PROTOCOLS = (SEEDED, SUITE)
_MOST_UNITS = 4_000_000
_OUTSIDE = re.compile(r"[^A-Za-z0-9._-]")
_LONGEST_FOLDER = 100


def plan_from(
    tasks: str | Sequence[str],
    *,
    policy: str,
    is_object: bool,
    episodes: int,
    seeds: Iterable[int] | None,
    num_seeds: int | None,
    protocol: str,
    keep: str,
    max_steps: int | None,
    camera: str | int | None,
    height: int | None,
    width: int | None,
    max_fps: float | None,
    quality: str,
    env_kwargs: Mapping[str, Any] | None,
    folders: Mapping[str, str] | None = None,
) -> EvaluationPlan:
    """Return the plan of an evaluation; `mjrec.evaluate` says what each means.

    `folders` are those that tasks have already, in an evaluation that is resumed.

    Raises:
        UnknownName, InvalidArgument: something cannot be.
        MissingDependency, EnvironmentNotMade: see `tasks_from`.
    """
    # What is quick to check comes first: sets of tasks start a process.
    if protocol not in _PROTOCOLS:
        raise UnknownName("protocol", protocol, _PROTOCOLS)
    checked_seeds = _seeds(seeds, num_seeds)
    count = _positive("episodes", episodes)
    episode_seeds(checked_seeds[0], count - 1)
    rule = keep_rule(keep)
    EnvironmentOptions(max_steps=max_steps, height=height, width=width)
    if max_fps is not None:
        to_rate(max_fps, name="max_fps")
    check_quality(quality)
    kwargs = _json_of(env_kwargs or {})
    names = tasks_from(tasks)
    units = len(names) * len(checked_seeds) * count
    if units > _MOST_UNITS:
        raise InvalidArgument(
            f"{len(names)} tasks, {len(checked_seeds)} seeds and {count} episodes are "
            f"{units} episodes; an evaluation has at most {_MOST_UNITS}."
        )
    return EvaluationPlan(
        tasks=_with_folders(names, folders or {}),
        policy=policy,
        is_object=is_object,
        seeds=checked_seeds,
        episodes=count,
        protocol=SUITE if protocol == SUITE else SEEDED,
        keep=rule.name,
        max_steps=None if max_steps is None else int(max_steps),
        camera=camera,
        height=None if height is None else int(height),
        width=None if width is None else int(width),
        max_fps=None if max_fps is None else float(max_fps),
        quality=quality,
        env_kwargs=kwargs,
    )


def check_score_ranges(
    score_ranges: Mapping[str, tuple[float, float]] | None, tasks: Iterable[str]
) -> dict[str, tuple[float, float]]:
    """Return the returns that count as 0 and as 1, for the tasks that have some given.

    Raises:
        UnknownName: one is of a task that is not evaluated.
        InvalidArgument: one is not two finite numbers, the lower one first.
    """
    names = list(tasks)
    checked = {}
    for task, given in (score_ranges or {}).items():
        if task not in names:
            raise UnknownName("task with a score range in this evaluation", task, names)
        checked[task] = _score_range(task, given)
    return checked


def _score_range(task: str, given: Any) -> tuple[float, float]:
    try:
        low, high = map(float, given)
    except (TypeError, ValueError):
        low = high = np.nan
    if not (np.isfinite([low, high]).all() and low < high):
        raise InvalidArgument(
            f"The score range of {task} must be the return that counts as 0 and a "
            f"higher one that counts as 1, such as (0, 1000), got {given!r}."
        )
    return low, high


def _seeds(seeds: Iterable[int] | None, num_seeds: int | None) -> tuple[int, ...]:
    if seeds is None:
        number = DEFAULT_SEEDS if num_seeds is None else num_seeds
        return tuple(range(_positive("num_seeds", number)))
    if num_seeds is not None:
        raise InvalidArgument(
            f"seeds={seeds!r} names the seeds and num_seeds={num_seeds!r} counts them "
            "from 0: give one of them."
        )
    if isinstance(seeds, int | np.integer):
        seeds = [int(seeds)]
    given = tuple(seeds)
    for seed in given:
        episode_seeds(seed, 0)
    if not given or len(set(given)) < len(given):
        raise InvalidArgument(
            f"seeds must be at least one, and each once, got {list(given)}."
        )
    return tuple(map(int, given))


def _positive(name: str, value: object) -> int:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < 1:  # type: ignore[operator]  # it is a number
        raise InvalidArgument(f"{name} must be a positive whole number, got {value!r}.")
    return int(value)  # type: ignore[call-overload, no-any-return]  # it is a number


def _json_of(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments as they come out of JSON, which is how they reach a worker."""
    kwargs = {}
    for name, value in env_kwargs.items():
        try:
            kwargs[name] = loads(json.dumps(value, allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            raise InvalidArgument(
                "env_kwargs go to other processes, and into a file, as JSON (texts, "
                f"numbers, lists and objects of them), and {name!r} cannot, which is "
                f"{value!r}: {error}."
            ) from error
    return kwargs


def _with_folders(
    names: Sequence[str], known: Mapping[str, str]
) -> tuple[EvaluatedTask, ...]:
    folders = dict(known)
    for name in names:
        if name not in folders:
            folders[name] = _folder(name, set(folders.values()))
    return tuple(EvaluatedTask(name, folders[name]) for name in names)


def _folder(name: str, taken: set[str]) -> str:
    parsed = parse_environment_name(name)
    # Where a file lies is nobody's business who is shown the results.
    text = parsed.path.name if isinstance(parsed, MjcfName) else name
    base = _OUTSIDE.sub(_encoded, text.replace("/", "-"))[:_LONGEST_FOLDER]
    # It is no hidden one, and none that leads elsewhere.
    base = f"-{base}" if base.startswith(".") else base
    folder, number = base, 1
    while folder in taken:
        number += 1
        folder = f"{base}-{number}"
    return folder


def _encoded(match: re.Match[str]) -> str:
    data = match[0].encode(errors="surrogateescape")
    return "".join(f"%{byte:02X}" for byte in data)

# SPDX-License-Identifier: Apache-2.0
"""Creating and checking the plan of an evaluation, without any environment.

A digest is stored for each part of a policy: the source file of its module, each file
named in its arguments, and the pickled content of an object. Workers add the digests of
imported modules. The digests prevent a resumed evaluation from mixing the results of
different policies.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import inspect
import itertools
import json
import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..atomic_files import file_sha256
from ..environments.episode_seeds import episode_seeds
from ..environments.named_environment import EnvironmentOptions
from ..environments.names import parse_environment_name, working_directory_importable
from ..errors import InvalidArgument, PolicyError, UnknownName
from ..frames import check_quality
from ..json_text import loads
from ..rates import to_rate
from ..recorder.keep_rules import keep_rule
from .plan import SEEDED, SUITE, Chunk, EvaluatedTask, EvaluationPlan
from .policy_digest import pickle_digest
from .task_sets import tasks_from

DEFAULT_SEEDS = 5

_PROTOCOLS = (SEEDED, SUITE)
_MOST_UNITS = 4_000_000
_OUTSIDE = re.compile(r"[^A-Za-z0-9._-]")
_LONGEST_FOLDER = 100

# A chunk costs about a tenth of a second and six files. With this number of chunks, as
# many processes can work on one task. Larger chunks would save little.
_USUAL_CHUNKS = 8
_MOST_EPISODES_OF_CHUNK = 25


def plan_from(
    tasks: str | Sequence[str],
    policy: Any,
    *,
    seeds: Iterable[int] | None,
    num_seeds: int | None,
    begun: EvaluationPlan | None = None,
    **options: Any,
) -> tuple[EvaluationPlan, bytes | None]:
    """Return the checked plan of an evaluation, and its pickled policy.

    The latter is None if the policy is a string.

    `mjrec.evaluate` describes the options.

    Args:
        tasks: see `evaluate`. If empty, the tasks of `begun` are used.
        policy: see `evaluate`.
        seeds: see `evaluate`. If `seeds` and `num_seeds` are both None, the seeds of
            `begun` are used.
        num_seeds: see `evaluate`.
        begun: the plan to continue, if any. Its folders and chunks are kept.
        **options: all fields of the plan that do not follow from the policy, the tasks
            and the seeds.

    Raises:
        UnknownName, InvalidArgument: an argument is invalid.
        MissingDependency, EnvironmentNotMade: see `tasks_from`.
        PolicyError: the policy is invalid or cannot be pickled.
    """
    policy_name, digests, payload = _sent_policy(policy, options["policy_kwargs"] or {})
    # Quick checks come first, because resolving sets of tasks starts a process.
    if options["protocol"] not in _PROTOCOLS:
        raise UnknownName("protocol", options["protocol"], _PROTOCOLS)
    is_same = begun is not None and seeds is None and num_seeds is None
    checked_seeds = begun.seeds if begun and is_same else _seeds(seeds, num_seeds)
    options["episodes"] = _positive("episodes", options["episodes"])
    episode_seeds(checked_seeds[0], options["episodes"] - 1)
    options["keep"] = keep_rule(options["keep"]).name
    for name in ("max_steps", "height", "width"):
        if options[name] is not None:
            options[name] = _positive(name, options[name])
    EnvironmentOptions(**{name: options[name] for name in ("height", "width")})
    if options["max_fps"] is not None:
        to_rate(options["max_fps"], name="max_fps")
        options["max_fps"] = float(options["max_fps"])
    if (timeout := options["episode_timeout"]) is not None and not 0 < timeout < 1e9:
        raise InvalidArgument(
            "episode_timeout must be a positive number of seconds below 1e9, but it is "
            f"{timeout!r}."
        )
    check_quality(options["quality"])
    for name in ("env_kwargs", "policy_kwargs"):
        options[name] = _json_of(name, options[name] or {})
    known = begun.tasks if begun else ()
    names = tasks_from(tasks) if tasks or not known else [each.name for each in known]
    units = len(names) * len(checked_seeds) * options["episodes"]
    if units > _MOST_UNITS:
        raise InvalidArgument(
            f"{len(names)} tasks with {len(checked_seeds)} seeds and "
            f"{options['episodes']} episodes per seed make {units} episodes, but an "
            f"evaluation can have at most {_MOST_UNITS}."
        )
    plan = EvaluationPlan(
        tasks=_with_folders(names, known),
        seeds=checked_seeds,
        policy=policy_name,
        is_object=payload is not None,
        policy_digests=digests,
        sources=begun.sources if begun else {},
        score_ranges=begun.score_ranges if begun else {},
        **options,
    )
    chunks = chunks_of(plan, begun.chunks if begun else ())
    return dataclasses.replace(plan, chunks=chunks), payload


def chunks_of(plan: EvaluationPlan, known: Sequence[Chunk]) -> tuple[Chunk, ...]:
    """Return the chunks of a plan.

    The known chunks are kept, and new chunks are added for all other episodes. A chunk
    has one seed or several consecutive seeds. With the protocol `"seeded"`, episodes
    are independent, so a seed with many episodes is split into several chunks.
    """
    stops = {seed: chunk.stop for chunk in known for seed in chunk.seeds}
    left: dict[int, list[int]] = {}
    for seed in sorted(plan.seeds):
        if (first := stops.get(seed, 0)) < plan.episodes:
            left.setdefault(first, []).append(seed)
    total = sum((plan.episodes - first) * len(seeds) for first, seeds in left.items())
    most = min(_MOST_EPISODES_OF_CHUNK, math.ceil(total / _USUAL_CHUNKS))
    chunks = list(known)
    for first, seeds in left.items():
        count = plan.episodes - first
        parts = 1 if plan.protocol == SUITE else math.ceil(count / most)
        cuts = [first + count * part // parts for part in range(parts + 1)]
        at_once = max(1, most // count)
        for index in range(0, len(seeds), at_once):
            group = tuple(seeds[index : index + at_once])
            for start, stop in itertools.pairwise(cuts):
                name = _chunk_name(group, start, stop, plan.episodes)
                chunks.append(Chunk(name, group, start, stop))
    return tuple(chunks)


def check_score_ranges(
    score_ranges: Mapping[str, tuple[float, float]] | None, tasks: Iterable[str]
) -> dict[str, tuple[float, float]]:
    """Check score ranges and return them, keyed by task.

    Raises:
        UnknownName: a range is given for a task that is not evaluated.
        InvalidArgument: a range does not consist of two finite numbers in ascending
            order.
    """
    names = list(tasks)
    checked = {}
    for task, given in (score_ranges or {}).items():
        if task not in names:
            raise UnknownName("task with a score range in this evaluation", task, names)
        try:
            low, high = map(float, given)
        except (TypeError, ValueError):
            low = high = np.nan
        if not (np.isfinite([low, high]).all() and low < high):
            raise InvalidArgument(
                f"The score range of {task} must be the return for a score of 0 and a "
                "higher return for a score of 1, such as (0, 1000), but it is "
                f"{given!r}."
            )
        checked[task] = low, high
    return checked


def _chunk_name(seeds: Sequence[int], first: int, stop: int, episodes: int) -> str:
    name = _range("seed", seeds[0], seeds[-1])
    is_whole = (first, stop) == (0, episodes)
    return name if is_whole else f"{name}-{_range('episode', first, stop - 1)}"


def _range(what: str, first: int, last: int) -> str:
    """Return a name such as `seed-003` for one number, or `seeds-000-011`."""
    if first == last:
        return f"{what}-{first:03d}"
    return f"{what}s-{first:03d}-{last:03d}"


def _seeds(seeds: Iterable[int] | None, num_seeds: int | None) -> tuple[int, ...]:
    if seeds is None:
        number = DEFAULT_SEEDS if num_seeds is None else num_seeds
        return tuple(range(_positive("num_seeds", number)))
    if num_seeds is not None:
        raise InvalidArgument(
            f"seeds={seeds!r} and num_seeds={num_seeds!r} were both given. Give only "
            "one of them: seeds lists the seeds, and num_seeds counts them from 0."
        )
    if isinstance(seeds, int | np.integer):
        seeds = [int(seeds)]
    given = tuple(seeds)
    for seed in given:
        episode_seeds(seed, 0)
    if not given or len(set(given)) < len(given):
        raise InvalidArgument(
            f"seeds must not be empty or contain duplicates, got {list(given)}."
        )
    return tuple(map(int, given))


def _positive(name: str, value: object) -> int:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < 1:  # type: ignore[operator]  # it is a number
        raise InvalidArgument(
            f"{name} must be a positive whole number, but it is {value!r}."
        )
    return int(value)  # type: ignore[call-overload, no-any-return]  # it is a number


def _json_of(what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Convert arguments to JSON and back, as happens on their way to a worker."""
    kwargs = {}
    for name, value in given.items():
        try:
            kwargs[name] = loads(json.dumps(value, allow_nan=False))
        except (TypeError, ValueError, RecursionError) as error:
            raise InvalidArgument(
                f"{what} must contain only JSON values (strings, numbers, lists and "
                "objects), because they are sent to other processes and stored in a "
                f"file. {name!r} is {value!r}, which is not such a value: {error}."
            ) from error
    return kwargs


def _with_folders(
    names: Sequence[str], known: Sequence[EvaluatedTask]
) -> tuple[EvaluatedTask, ...]:
    tasks = {task.name: task for task in known}
    for name in names:
        if name not in tasks:
            taken = {task.folder for task in tasks.values()}
            tasks[name] = EvaluatedTask(name, _folder(name, taken))
    return tuple(tasks[name] for name in names)


def _folder(name: str, taken: set[str]) -> str:
    is_file = parse_environment_name(name).framework == "mjcf"
    # The results must not reveal where a file was stored.
    text = Path(name).name if is_file else name
    base = _OUTSIDE.sub(_encoded, text.replace("/", "-"))[:_LONGEST_FOLDER]
    # Avoids hidden folders and relative paths such as `..`.
    base = f"-{base}" if base.startswith(".") else base
    folder, number = base, 1
    while folder in taken:
        number += 1
        folder = f"{base}-{number}"
    return folder


def _encoded(match: re.Match[str]) -> str:
    data = match[0].encode(errors="surrogateescape")
    return "".join(f"%{byte:02X}" for byte in data)


def _sent_policy(
    policy: Any, kwargs: Mapping[str, Any]
) -> tuple[str, dict[str, str], bytes | None]:
    """Convert a policy to a form that can be sent to workers.

    Args:
        policy: a string as in `mjrec record`, a function, an object with `predict`, or
            a class that is called with each environment.
        kwargs: keyword arguments for the policy.

    Returns:
        The name, the digests, and the pickled object; None if the policy is a string.

    Raises:
        PolicyError: `policy` is not a valid policy or cannot be pickled.
    """
    files: dict[str, str | None] = {
        f"the file of its argument {name}": value
        for name, value in kwargs.items()
        if isinstance(value, str)
    }
    if isinstance(policy, str):
        return policy, _digests({**_source_of(policy), **files}), None
    if not (callable(policy) or callable(getattr(policy, "predict", None))):
        raise PolicyError(
            f"The policy {policy!r:.200} is not callable and has no predict() method. "
            "Pass a function, an object with predict(), a class that is called with "
            "the environment, or a string: random, zero, module:name or module:name()."
        )
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    module = inspect.getmodule(named)
    name = str(named.__qualname__)
    name = name if module is None else f"{module.__name__}:{name}"
    payload = _pickled(policy, name)
    content = {"its content": pickle_digest(payload, ignored=_random_class_names())}
    files = {"its code": getattr(module, "__file__", None), **files}
    return name, {**content, **_digests(files)}, payload


def _source_of(policy: str) -> dict[str, str | None]:
    """Return the policy file, or the source file of the policy's module."""
    module, colon, _ = policy.partition(":")
    if not colon:
        return {"its file": policy}
    source = getattr(sys.modules.get(module), "__file__", None)
    try:
        if source is None:
            with working_directory_importable():
                found = importlib.util.find_spec(module)
            source = None if found is None else found.origin
    except Exception:
        # The workers will import the module and report the error.
        return {}
    return {"its code": source}


def _digests(files: Mapping[str, str | None]) -> dict[str, str]:
    """Return the SHA-256 of each file that exists."""
    digests = {}
    for what, name in files.items():
        with contextlib.suppress(OSError):
            if name is not None and Path(name).is_file():
                digests[what] = file_sha256(Path(name))
    return digests


def _pickled(policy: Any, name: str) -> bytes:
    # Imported here because only an evaluation with an object needs cloudpickle, which
    # is a dependency of gymnasium. The pickle is sent through our own pipe to our own
    # processes.
    import cloudpickle  # type: ignore[import-untyped]  # it has no types

    try:
        payload: bytes = cloudpickle.dumps(policy)
    except Exception as error:
        raise PolicyError(
            f"The policy {name} cannot be sent to the worker processes: "
            f"{type(error).__name__}: {error}. Pass its name instead "
            "(policy='module:name'). Each process then imports the policy or, if it is "
            "a class, builds it with the environment."
        ) from error
    return payload


def _random_class_names() -> set[str]:
    """Return the names that cloudpickle gives to the classes it pickles by value."""
    from cloudpickle import cloudpickle

    return {*getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_CLASS", {}).values()}

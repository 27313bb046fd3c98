# SPDX-License-Identifier: Apache-2.0
"""What the inputs of a run say of its author: reproducible is not yet honest.

A run whose author chose the seeds, showed one episode as two or left episodes out can
be made again all the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import json_text
from ..environments.episode_seeds import episode_seeds
from .findings import Finding, Outcome, Topic
from .inputs import EpisodeInputs, Inputs, RecordingInputs

_MOST_SHOWN = 5


def remarks(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield what a reader should know, whatever else comes out.

    Args:
        inputs: of the run.
        arrays: the actions that they name.
    """
    for recording in inputs.recordings:
        yield from _gaps(recording, inputs.recordings)
        yield from _seeds(recording)
    yield from _repeated(inputs, arrays)


def _gaps(
    recording: RecordingInputs, all_of_them: Sequence[RecordingInputs]
) -> Iterator[Finding]:
    first = recording.first_episode_id
    numbers = {each.episode_id for each in recording.episodes}
    missing = set(range(first, max(numbers, default=first - 1) + 1)) - numbers
    if missing:
        yield _headline(
            Topic.SELECTION,
            recording.name,
            f"episodes are missing: {_listed(missing)}",
            outcome=Outcome.DIFFERENT,
            count=len(missing),
        )
    absent = set(range(first))
    for other in all_of_them if first else ():
        absent.difference_update(each.episode_id for each in other.episodes)
    if absent:
        yield _headline(
            Topic.SELECTION,
            recording.name,
            f"it begins with episode {first}, and the recordings that it went on from "
            f"are not here: {_listed(absent)} are missing",
            outcome=Outcome.BELIEVED,
            count=len(absent),
        )
    cut = [each for each in recording.episodes if each.cut is not None]
    if cut:
        yield Finding(
            topic=Topic.SELECTION,
            item=recording.name,
            outcome=Outcome.NOTED,
            reason=f"episodes that are not in the statistics, as they were cut off: "
            f"{_listed(each.episode_id for each in cut)}",
            count=len(cut),
            unit="episode",
        )


def _seeds(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield by which rule the seeds of a recording follow."""
    given = [each for each in recording.episodes if each.seed is not None]
    if not given:
        return
    rule = _rule_of(recording.episodes, given, recording.options.get("seed"))
    yield Finding(
        topic=Topic.BEGINNING,
        item=recording.name,
        outcome=Outcome.NOTED,
        reason=rule or "seeds chosen by the author: they follow no stated rule",
        count=len(given),
        unit="seed",
    )


def _rule_of(
    episodes: Sequence[EpisodeInputs], given: Sequence[EpisodeInputs], seed: int | None
) -> str | None:
    first = episodes[0]
    if all(each.evaluation is not None for each in episodes):
        return _rule_of_evaluation(episodes)
    if len(given) == 1 and given[0] is first:
        return f"one seed, {first.seed}, at the first reset"
    if seed is None or not 0 <= seed < 2**32:
        return None
    follows = all(
        each.seed == episode_seeds(seed, each.episode_id).environment
        for each in episodes
    )
    return f"SeedSequence([{seed}, i]) for episode i" if follows else None


def _rule_of_evaluation(episodes: Sequence[EpisodeInputs]) -> str | None:
    seeds = set()
    for each in episodes:
        said = each.evaluation or {}
        seed, number = said.get("seed"), said.get("episode")
        if type(seed) is not int or type(number) is not int:
            return None
        if not (0 <= seed < 2**32 and 0 <= number < 2**32):
            return None
        if each.seed != episode_seeds(seed, number).environment:
            return None
        seeds.add(seed)
    return f"SeedSequence([S, i]) for episode i, S of {_listed(seeds)}"


def _repeated(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield which episodes are the same, anywhere: they count once."""
    found: dict[str, list[str]] = {}
    for recording in inputs.recordings:
        for each in recording.episodes:
            if each.actions is None or not each.steps:
                continue
            what = [recording.env_id, each.seed, each.irregular]
            if each.seed is None:
                what += [each.random_state, _digest(arrays.get(each.first_state or ""))]
            what.append(_digest(arrays.get(each.actions)))
            found.setdefault(json_text.dumps(what), []).append(recording.item(each))
    for items in found.values():
        if len(items) > 1:
            yield _headline(
                Topic.SELECTION,
                items[0],
                f"the same episode, begun and acted alike: {_listed(items)}; it counts "
                "once",
                outcome=Outcome.BELIEVED,
                count=len(items) - 1,
            )


def _digest(array: NDArray[Any] | None) -> str:
    content = b"" if array is None else np.ascontiguousarray(array).tobytes()
    return hashlib.sha256(content).hexdigest()


def _headline(
    topic: Topic, item: str, reason: str, *, outcome: Outcome, count: int
) -> Finding:
    return Finding(
        topic=topic,
        item=item,
        outcome=outcome,
        reason=reason,
        count=count,
        unit="episode",
        is_headline=True,
    )


def _listed(items: Any) -> str:
    ordered = sorted(items)
    shown = ", ".join(map(str, ordered[:_MOST_SHOWN]))
    left = len(ordered) - _MOST_SHOWN
    return f"{shown} and {left} more" if left > 0 else shown

# SPDX-License-Identifier: Apache-2.0
"""What a reader should know of a run that can be made again: that is not yet honest.

Its author may have chosen the seeds, shown one episode as two, or left some out. A
video may show a part of its episode, or be faster than real time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import json_text
from ..environments.episode_seeds import episode_seeds
from ..formats.json_fields import read_object
from ..formats.video_metadata import metadata_path
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


def read_metadata(video: Path) -> Mapping[str, Any]:
    """Return what the metadata file of a video says; nothing where it is damaged."""
    return _read(metadata_path(video))


def remarks_on_video(metadata: Path, file: str) -> Iterator[Finding]:
    """Yield what a reader would not expect of a video.

    Args:
        metadata: its metadata file.
        file: the name of that, below `data/`.
    """
    for reason in _of_video(_read(metadata)):
        yield Finding(
            topic=Topic.VIDEOS,
            item=file,
            outcome=Outcome.NOTED,
            reason=reason,
            unit="video",
        )


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


def _of_video(said: Mapping[str, Any]) -> Iterator[str]:
    if said.get("empty"):
        yield "has no frames"
        return
    speed = said.get("playback_speed")
    if isinstance(speed, int | float) and abs(speed - 1) > 1e-9:
        yield f"plays at {speed:g} times real time"
    elif speed is None and said.get("content_type") == "video/mp4":
        yield "does not say how fast it plays: how long a step lasts is not known"
    if said.get("broken"):
        yield f"broke off: {said.get('broken_reason')}"
    elif said.get("complete") is False:
        yield f"shows an episode that did not end: {said.get('reason')}"
    if "first_step" in said:
        yield "is a clip, not a whole episode"
    elif (runs := said.get("frame_steps")) and not _is_whole(runs, said.get("length")):
        yield "does not show its episode from the reset to the last step"
    if said.get("first_video"):
        yield "shows a further camera"
    if said.get("recording") == "live":
        yield f"was drawn while its episode ran: {said.get('recording_reason')}"
    for key, meaning in (
        ("annotated", "has captions drawn into its frames"),
        ("packed_smaller", "was drawn again in a smaller size to be packed"),
    ):
        if said.get(key):
            yield meaning
    if said.get("quality") == "draft":
        yield "is drawn in draft quality"


def _is_whole(runs: Any, length: Any) -> bool:
    try:
        return bool(runs[0][0] == 0 and runs[-1][1] == length)
    except (TypeError, LookupError):
        return False


def _read(path: Path) -> Mapping[str, Any]:
    try:
        return read_object(path)
    except (OSError, ValueError):
        return {}

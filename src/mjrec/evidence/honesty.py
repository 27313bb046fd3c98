# SPDX-License-Identifier: Apache-2.0
"""Remarks on a run that may be misleading even if it can be recreated.

Its author may have chosen the seeds, shown one episode as two, or left some out. A
video may show only part of its episode, or be faster than real time.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
# The form of ids in Gymnasium's registry and dm_control's suite.
_REGISTERED = re.compile(r"dm_control/.+|.+-v\d+")


def remarks(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield what a reader should know regardless of the comparison's result.

    Args:
        inputs: the run's inputs.
        arrays: the arrays that the inputs name.
    """
    yield from _unfinished(inputs)
    for recording in inputs.recordings:
        yield from _name(recording)
        yield from _gaps(recording, inputs.recordings)
        yield from _cuts(recording, inputs.recordings)
        yield from _types(recording)
        yield from _faults(recording)
        yield from _seeds(recording)
    yield from _gaps_of_evaluations(inputs.recordings)
    yield from _repeated(inputs, arrays)


def read_metadata(video: Path) -> Mapping[str, Any]:
    """Return a video's metadata; empty if the metadata file cannot be read."""
    return _read(metadata_path(video))


def remarks_on_video(metadata: Path, file: str) -> Iterator[Finding]:
    """Yield the facts about a video that a reader would not expect.

    Args:
        metadata: the video's metadata file.
        file: the metadata file's name below `data/`.
    """
    for reason in _of_video(_read(metadata)):
        yield Finding(
            topic=Topic.VIDEOS,
            item=file,
            outcome=Outcome.NOTED,
            reason=reason,
            unit="video",
        )


def _unfinished(inputs: Inputs) -> Iterator[Finding]:
    """Yield a remark if an evaluation planned more episodes than are complete."""
    episodes = [each for one in inputs.recordings for each in one.episodes]
    complete, planned = sum(e.cut is None for e in episodes), inputs.planned or 0
    if complete < planned:
        yield _headline(
            Topic.SELECTION,
            "",
            f"{complete} of {planned} episodes: the evaluation is not finished, or "
            "some of its episodes failed",
            outcome=Outcome.BELIEVED,
            count=planned - complete,
        )


def _name(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield a remark if an environment goes by a name that is not its own."""
    environment = recording.environment or {}
    env_id, name = environment.get("id"), recording.env_id
    if env_id is not None and name != env_id:
        is_anothers = _REGISTERED.fullmatch(name) is not None
        yield _headline(
            Topic.IDENTITY,
            recording.name,
            f"its name is {name!r:.80}, but its environment is {env_id!r:.80}",
            outcome=Outcome.DIFFERENT if is_anothers else Outcome.BELIEVED,
            unit="recording",
        )
    elif environment.get("framework") == "mjcf" and _REGISTERED.fullmatch(name):
        yield _headline(
            Topic.IDENTITY,
            recording.name,
            f"{name!r:.80} is the author's own model (MJCF), not the environment of "
            "that name",
            outcome=Outcome.NOTED,
            unit="recording",
        )


def _gaps(
    recording: RecordingInputs, all_of_them: Sequence[RecordingInputs]
) -> Iterator[Finding]:
    first = recording.first_episode_id
    numbers = {each.episode_id for each in recording.episodes}
    count, missing = _missing(numbers, first, max(numbers, default=first - 1) + 1)
    if count:
        yield _headline(
            Topic.SELECTION,
            recording.name,
            f"episodes are missing: {missing}",
            outcome=Outcome.DIFFERENT,
            count=count,
        )
    before = {
        each.episode_id
        for other in all_of_them
        if other.environment == recording.environment
        for each in other.episodes
    }
    count, missing = _missing(before, 0, first)
    if count:
        yield _headline(
            Topic.SELECTION,
            recording.name,
            f"it begins with episode {first}, and the earlier recordings of its "
            f"environment are not included: {missing} are missing",
            outcome=Outcome.BELIEVED,
            count=count,
        )


def _cuts(
    recording: RecordingInputs, all_of_them: Sequence[RecordingInputs]
) -> Iterator[Finding]:
    """Yield the episodes that are not in the statistics because they were cut off."""
    cut = [each.episode_id for each in recording.episodes if each.cut is not None]
    if not cut:
        return
    # A run is normally closed once. Closing it early and continuing in a new recording
    # is a way to leave out bad episodes.
    goes_on = any(
        other.first_episode_id > max(cut) and other.env_id == recording.env_id
        for other in all_of_them
    )
    then = ", and another recording continues after them" if goes_on else ""
    yield _headline(
        Topic.SELECTION,
        recording.name,
        f"episodes not in the statistics because they were cut off: "
        f"{_listed(cut)}{then}",
        outcome=Outcome.BELIEVED if goes_on else Outcome.NOTED,
        count=len(cut),
    )


def _types(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the training episodes of a recording that mixes them with evaluation."""
    complete = [each for each in recording.episodes if each.cut is None]
    training = [each.episode_id for each in complete if each.type != "e"]
    if training and len(training) < len(complete):
        yield _headline(
            Topic.SELECTION,
            recording.name,
            f"{len(training)} of {len(complete)} episodes are labelled training, the "
            f"others evaluation: {_listed(training)}",
            outcome=Outcome.NOTED,
            count=len(training),
        )


def _faults(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the faults of the recorder. All of their effects are compared."""
    said = [
        f"{fault['what']}: {fault['reason']:.200}"
        if fault["episode_id"] is None
        else f"{fault['what']} of episode {fault['episode_id']}: {fault['reason']:.200}"
        for _, fault in recording.faults
    ]
    if said:
        yield _headline(
            Topic.SELECTION,
            recording.name,
            "faults while recording, according to its author: "
            f"{_shown(said[:_MOST_SHOWN], len(said))}",
            outcome=Outcome.NOTED,
            count=len(said),
            unit="fault",
        )


def _gaps_of_evaluations(recordings: Sequence[RecordingInputs]) -> Iterator[Finding]:
    """Yield the episodes of each evaluation seed that are missing.

    Episodes are numbered from 0, across all recordings of an environment.
    """
    numbers: dict[tuple[str, int], set[int]] = {}
    for recording in recordings:
        for each in recording.episodes:
            said = each.evaluation or {}
            seed, number = said.get("seed"), said.get("episode")
            if type(seed) is int and type(number) is int:
                numbers.setdefault((recording.env_id, seed), set()).add(number)
    for (env_id, seed), known in numbers.items():
        count, missing = _missing(known, 0, max(known) + 1)
        if count:
            yield _headline(
                Topic.SELECTION,
                f"{env_id:.80}, seed {seed}",
                f"episodes of the evaluation that are missing or failed: {missing}",
                outcome=Outcome.BELIEVED,
                count=count,
            )


def _seeds(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the rule that the seeds of a recording follow."""
    given = [each for each in recording.episodes if each.seed is not None]
    if not given:
        return
    rule = _rule_of(recording.episodes, given, recording.options.get("seed"))
    yield Finding(
        topic=Topic.BEGINNING,
        item=recording.name,
        outcome=Outcome.NOTED,
        reason=rule or "seeds chosen by the author: they do not follow a stated rule",
        count=len(given),
        unit="seed",
    )


def _rule_of(
    episodes: Sequence[EpisodeInputs], given: Sequence[EpisodeInputs], seed: int | None
) -> str | None:
    first = episodes[0]
    is_evaluation = all(each.evaluation is not None for each in episodes)
    if not is_evaluation and len(given) == 1 and given[0] is first:
        return f"one seed, {first.seed}, at the first reset"
    pairs: list[tuple[Any, Any]] = [(seed, each.episode_id) for each in episodes]
    if is_evaluation:
        said = [each.evaluation or {} for each in episodes]
        pairs = [(each.get("seed"), each.get("episode")) for each in said]
    for each, numbers in zip(episodes, pairs, strict=True):
        if not all(type(n) is int and 0 <= n < 2**32 for n in numbers):
            return None
        if each.seed != episode_seeds(*numbers).environment:
            return None
    if is_evaluation:
        seeds = _listed({seed for seed, _ in pairs})
        return f"SeedSequence([S, i]) for episode i, S in {seeds}"
    return f"SeedSequence([{seed}, i]) for episode i"


def _repeated(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield the groups of identical episodes in all recordings; each counts once."""
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
                "the same episode, with the same beginning and actions: "
                f"{_listed(items)}; it counts once",
                outcome=Outcome.BELIEVED,
                count=len(items) - 1,
            )


def _digest(array: NDArray[Any] | None) -> str:
    content = b"" if array is None else np.ascontiguousarray(array).tobytes()
    return hashlib.sha256(content).hexdigest()


def _headline(
    topic: Topic,
    item: str,
    reason: str,
    *,
    outcome: Outcome,
    count: int = 1,
    unit: str = "episode",
) -> Finding:
    return Finding(
        topic=topic,
        item=item,
        outcome=outcome,
        reason=reason,
        count=count,
        unit=unit,
        is_headline=True,
    )


def _missing(known: set[int], start: int, stop: int) -> tuple[int, str]:
    """Return the number of unknown numbers in a range, and the first few as a list."""
    count = max(0, stop - start) - sum(start <= number < stop for number in known)
    missing = (number for number in range(start, stop) if number not in known)
    return count, _shown(itertools.islice(missing, min(count, _MOST_SHOWN)), count)


def _listed(items: Iterable[Any]) -> str:
    ordered = sorted(items)
    return _shown(ordered[:_MOST_SHOWN], len(ordered))


def _shown(first: Iterable[Any], count: int) -> str:
    text, more = ", ".join(map(str, first)), count - _MOST_SHOWN
    return f"{text} and {more} more" if more > 0 else text


def _of_video(said: Mapping[str, Any]) -> Iterator[str]:
    if said.get("empty"):
        yield "has no frames"
        return
    speed = said.get("playback_speed")
    if isinstance(speed, int | float) and abs(speed - 1) > 1e-9:
        yield f"plays at {speed:g} times real time"
    elif speed is None and said.get("content_type") == "video/mp4":
        yield "does not state its playback speed: the length of a step is unknown"
    if said.get("broken"):
        yield f"broke off: {said.get('broken_reason')}"
    elif said.get("complete") is False:
        yield f"shows an incomplete episode: {said.get('reason')}"
    if "first_step" in said:
        yield "is a clip, not a whole episode"
    elif (runs := said.get("frame_steps")) and not _is_whole(runs, said.get("length")):
        yield "does not show the whole episode, from the reset to the last step"
    if said.get("first_video"):
        yield "shows a further camera"
    if said.get("recording") == "live":
        yield f"was rendered during the episode: {said.get('recording_reason')}"
    for key, meaning in (
        ("annotated", "has captions drawn into its frames"),
        ("packed_smaller", "was re-rendered at a smaller size for packing"),
    ):
        if said.get(key):
            yield meaning
    if said.get("quality") == "draft":
        yield "was rendered in draft quality"


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

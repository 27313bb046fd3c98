# SPDX-License-Identifier: Apache-2.0
"""Remarks on a run that may be misleading even if it can be recreated.

Its author may have chosen the seeds, shown one episode as two, or left some episodes
out. A video may show only part of its episode, or be faster than real time.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import json_text
from ..environments.episode_seeds import episode_seeds
from ..plain_text import listed
from .findings import Finding, Outcome, Topic
from .inputs import EpisodeInputs, Inputs, RecordingInputs

_MOST_SHOWN = 5
# The form of ids in Gymnasium's registry and dm_control's suite.
_REGISTERED = re.compile(r"dm_control/.+|.+-v\d+")


def remarks(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield remarks that concern a reader regardless of the comparison's result.

    Args:
        inputs: the run's inputs.
        arrays: the arrays that the inputs refer to.
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


def remarks_on_video(metadata: Mapping[str, Any], file: str) -> Iterator[Finding]:
    """Yield the facts about a video that a reader would not expect.

    Args:
        metadata: the video's metadata.
        file: the metadata file's name below `data/`.
    """
    for reason in _of_video(metadata):
        yield Finding(Topic.VIDEOS, file, Outcome.NOTED, reason, unit="video")


def _unfinished(inputs: Inputs) -> Iterator[Finding]:
    """Yield a remark if an evaluation planned more episodes than are complete."""
    episodes = [each for one in inputs.recordings for each in one.episodes]
    complete, planned = sum(e.cut is None for e in episodes), inputs.planned or 0
    if complete < planned:
        reason = (
            f"{complete} of {planned} episodes: the evaluation is not finished, or "
            "some of its episodes failed"
        )
        yield _headline("", reason, Outcome.BELIEVED, planned - complete)


def _name(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield a remark if a recording's name is not that of its environment."""
    environment = recording.environment or {}
    env_id, name = environment.get("id"), recording.env_id
    is_registered = _REGISTERED.fullmatch(name) is not None
    if env_id is not None and name != env_id:
        reason = f"its name is {name!r:.80}, but its environment is {env_id!r:.80}"
        outcome = Outcome.DIFFERENT if is_registered else Outcome.BELIEVED
    elif environment.get("framework") == "mjcf" and is_registered:
        reason = (
            f"{name!r:.80} is the author's own model (MJCF), not the environment of "
            "that name"
        )
        outcome = Outcome.NOTED
    else:
        return
    remark = _headline(recording.name, reason, outcome, unit="recording")
    yield dataclasses.replace(remark, topic=Topic.IDENTITY)


def _gaps(
    recording: RecordingInputs, all_of_them: Sequence[RecordingInputs]
) -> Iterator[Finding]:
    first, name = recording.first_episode_id, recording.name
    numbers = {each.episode_id for each in recording.episodes}
    count, missing = _missing(numbers, first, max(numbers, default=first - 1) + 1)
    if count:
        reason = f"episodes are missing: {missing}"
        yield _headline(name, reason, Outcome.DIFFERENT, count)
    before = {
        each.episode_id
        for other in all_of_them
        if other.environment == recording.environment
        for each in other.episodes
    }
    count, missing = _missing(before, 0, first)
    if count:
        reason = (
            f"it begins with episode {first}, and the earlier recordings of its "
            f"environment are not included: {missing} are missing"
        )
        yield _headline(name, reason, Outcome.BELIEVED, count)


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
    reason = (
        f"episodes not in the statistics because they were cut off: "
        f"{listed(sorted(cut), _MOST_SHOWN)}{then}"
    )
    outcome = Outcome.BELIEVED if goes_on else Outcome.NOTED
    yield _headline(recording.name, reason, outcome, len(cut))


def _types(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the training episodes of a recording that also contains evaluation."""
    complete = [each for each in recording.episodes if each.cut is None]
    training = [each.episode_id for each in complete if each.type != "e"]
    if training and len(training) < len(complete):
        reason = (
            f"{len(training)} of {len(complete)} episodes are labeled training, the "
            f"others evaluation: {listed(sorted(training), _MOST_SHOWN)}"
        )
        yield _headline(recording.name, reason, Outcome.NOTED, len(training))


def _faults(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the faults of the recorder. All of their effects are compared."""
    said = []
    for _, fault in recording.faults:
        number = fault["episode_id"]
        of = "" if number is None else f" of episode {number}"
        said.append(f"{fault['what']}{of}: {fault['reason']:.200}")
    if said:
        shown = listed(said, _MOST_SHOWN)
        reason = f"faults while recording, according to its author: {shown}"
        yield _headline(recording.name, reason, Outcome.NOTED, len(said), unit="fault")


def _gaps_of_evaluations(recordings: Sequence[RecordingInputs]) -> Iterator[Finding]:
    """Yield a finding for each evaluation seed that has missing episodes.

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
            reason = f"episodes of the evaluation that are missing or failed: {missing}"
            item = f"{env_id:.80}, seed {seed}"
            yield _headline(item, reason, Outcome.BELIEVED, count)


def _seeds(recording: RecordingInputs) -> Iterator[Finding]:
    """Yield the rule that the seeds of a recording follow."""
    given = [each for each in recording.episodes if each.seed is not None]
    if not given:
        return
    rule = _rule_of(recording.episodes, given, recording.options.get("seed"))
    reason = rule or "seeds chosen by the author: they do not follow a stated rule"
    item, outcome, count = recording.name, Outcome.NOTED, len(given)
    yield Finding(Topic.BEGINNING, item, outcome, reason, count=count, unit="seed")


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
        seeds = listed(sorted({seed for seed, _ in pairs}), _MOST_SHOWN)
        return f"SeedSequence([S, i]) for episode i, S in {seeds}"
    return f"SeedSequence([{seed}, i]) for episode i"


def _repeated(inputs: Inputs, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Yield the groups of identical episodes in all recordings; a group counts once."""
    found: dict[str, list[str]] = {}
    for recording in inputs.recordings:
        for each in recording.episodes:
            if not each.steps:
                continue
            for what in _contents(each, arrays):
                key = json_text.dumps([recording.env_id, *what])
                found.setdefault(key, []).append(recording.item(each))
    # Episodes may be equal in both their states and their actions.
    for items in dict.fromkeys(map(tuple, found.values())):
        if len(items) > 1:
            reason = (
                "the same episode, with the same states or the same seed and actions: "
                f"{listed(sorted(items), _MOST_SHOWN)}; it counts once"
            )
            yield _headline(items[0], reason, Outcome.BELIEVED, len(items) - 1)


def _contents(
    episode: EpisodeInputs, arrays: Mapping[str, NDArray[Any]]
) -> Iterator[list[Any]]:
    """Yield what two equal episodes have in common: what was played, and why."""
    if episode.played is not None:
        yield [episode.played]
    if episode.has_actions:
        what = [episode.seed, episode.irregular]
        if episode.seed is None:
            state = _digest(arrays.get(f"{episode.arrays}.state"))
            what += [episode.random_state, state]
        yield [*what, _digest(arrays.get(episode.arrays or ""))]


def _digest(array: NDArray[Any] | None) -> str:
    content = b"" if array is None else np.ascontiguousarray(array).tobytes()
    return hashlib.sha256(content).hexdigest()


def _headline(
    item: str, reason: str, outcome: Outcome, count: int = 1, *, unit: str = "episode"
) -> Finding:
    topic = Topic.SELECTION
    return Finding(
        topic, item, outcome, reason, count=count, unit=unit, is_headline=True
    )


def _missing(known: set[int], start: int, stop: int) -> tuple[int, str]:
    """Return how many numbers in a range are unknown, and a list of the first few."""
    count = max(0, stop - start) - sum(start <= number < stop for number in known)
    missing = (number for number in range(start, stop) if number not in known)
    first = [*itertools.islice(missing, min(count, _MOST_SHOWN))]
    return count, listed(first, _MOST_SHOWN, count=count)


def _of_video(said: Mapping[str, Any]) -> Iterator[str]:
    if said.get("empty"):
        yield "has no frames"
        return
    speed = said.get("playback_speed")
    if isinstance(speed, int | float) and abs(speed - 1) > 1e-9:
        yield f"plays at {speed:g} times real time"
    elif speed is None and said.get("content_type") == "video/mp4":
        yield "does not state its playback speed: the duration of a step is unknown"
    if said.get("broken"):
        yield f"was cut short: {said.get('broken_reason')}"
    elif said.get("complete") is False:
        yield f"shows an incomplete episode: {said.get('reason')}"
    if "first_step" in said:
        yield "is a clip, not a whole episode"
    elif (runs := said.get("frame_steps")) and not _is_whole(runs, said.get("length")):
        yield "does not show the whole episode, from the reset to the last step"
    if said.get("first_video"):
        yield "shows an additional camera"
    if said.get("recording") == "live":
        yield f"was rendered during the episode: {said.get('recording_reason')}"
    for key, meaning in (
        ("annotated", "has captions drawn into its frames"),
        ("packed_smaller", "was rerendered at a smaller size for packing"),
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

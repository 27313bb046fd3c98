# SPDX-License-Identifier: Apache-2.0
"""Recreation of an evaluation's choice of episodes.

An evaluation chooses its videos from the episodes of all recordings of an environment.
If the archive contains all of these, the rule is applied again. If some are missing, or
the evaluation was extended, the choice is believed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InvalidArgument
from ..formats.journal import read_journal
from ..formats.monitor_directory import journal_name
from ..plain_text import counted
from ..recorder.keep_rules import keep_rule
from ..rendering.chosen_videos import write_choice
from ..rendering.jobs import RecordingKey
from .excuses import note
from .findings import Finding
from .inputs import RecordingInputs


class _Ended(NamedTuple):
    """A finished episode of an evaluation."""

    key: RecordingKey
    reward: float | None
    terminated: bool | None
    success: bool | None


# The chosen episodes with their roles, keyed by the number of episodes to choose from.
_Choices = dict[int, dict[RecordingKey, list[str]]]


def choose_for_evaluations(
    recordings: Iterable[RecordingInputs], directory: Path, notes: list[Finding]
) -> None:
    """Choose the videos of evaluations, and store the choice with their recordings.

    Args:
        recordings: the inputs of all recordings.
        directory: the directory of the recreated recordings. Their monitors must be
            closed.
        notes: receives notes on the choices that are believed.
    """
    groups: dict[str, list[RecordingInputs]] = {}
    for each in recordings:
        if (directory / journal_name(each.infix)).exists() and each.is_evaluation:
            # Arguments may differ: some tasks are sampled from the seed.
            groups.setdefault(each.env_id, []).append(each)
    for group in groups.values():
        rules = {str(keep.get("rule")) for e in group for keep in e.evaluation_keeps}
        for rule in sorted(rules):
            _choose(group, rule, directory, notes)


def _choose(
    group: list[RecordingInputs], rule: str, directory: Path, notes: list[Finding]
) -> None:
    choices = _stated(group)
    again = _recreated(group, rule, directory)
    if choices.keys() == again.keys():
        choices = again
    else:
        among = " and later ".join(map(str, sorted(choices)))
        here = counted(sum(len(each.episodes) for each in group), "episode")
        reason = (
            f"its videos were chosen from {among} episodes of an evaluation, but the "
            f"archive has {here}: the choice by the rule {rule!r:.80} is believed"
        )
        count = sum(map(len, choices.values()))
        notes.append(note(group[0].name, "rule", reason, count=count, unit="video"))
    for finished, chosen in sorted(choices.items()):
        for each in group:
            own = {k: roles for k, roles in chosen.items() if k.infix == each.infix}
            write_choice(directory, own, rule=rule, finished=finished, among=each.infix)


def _stated(group: Iterable[RecordingInputs]) -> _Choices:
    """Return the choices that the archive states."""
    found: _Choices = {}
    for recording in group:
        known: set[int] = set()
        for keep in recording.evaluation_keeps:
            numbers = {*keep["chosen"]} - known
            chosen = found.setdefault(_count(keep), {})
            # A later choice overwrites the roles of an earlier one.
            chosen |= {_key(recording, number): [] for number in numbers}
            known |= numbers
        for episode in recording.episodes:
            if (selection := episode.selection) is not None:
                key = _key(recording, episode.episode_id)
                roles = selection.get("roles")
                found.setdefault(_count(selection), {})[key] = [*map(str, roles or ())]
    return found


def _recreated(
    group: Iterable[RecordingInputs], rule: str, directory: Path
) -> _Choices:
    """Return the episodes that the rule chooses from all replayed episodes."""
    ended: dict[tuple[Any, Any], _Ended | None] = {}
    for recording in group:
        for facts in recording.failed:
            number, failed = facts.get("episode_id"), None
            if isinstance(number, int):
                failed = _Ended(_key(recording, number), None, None, None)
            ended[facts["seed"], facts["episode"]] = failed
        for entry in read_journal(
            directory / journal_name(recording.infix), warns=True
        ):
            unit, key = entry.evaluation or {}, _key(recording, entry.episode_id)
            ended[unit.get("seed"), unit.get("episode")] = _Ended(
                key, entry.reward, entry.terminated, entry.success
            )
    try:
        chosen = keep_rule(rule).choose([ended[unit] for unit in sorted(ended)])
    except InvalidArgument:
        return {}
    roles: dict[RecordingKey, list[str]] = {}
    for each, role in chosen:
        roles.setdefault(each.key, []).append(role)
    return {len(ended): roles}


def _key(recording: RecordingInputs, number: int) -> RecordingKey:
    return RecordingKey(recording.infix, number)


def _count(facts: Mapping[str, object]) -> int:
    finished = facts.get("finished")
    return finished if isinstance(finished, int) else 0

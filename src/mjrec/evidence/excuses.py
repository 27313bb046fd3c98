# SPDX-License-Identifier: Apache-2.0
"""Excuses: claims that allow certain differences, and tests of these claims.

The exact comparison always comes first. Each excuse applies to the recordings, episodes
or files that it is claimed for. As its rule below specifies, it either widens a finite
tolerance or exempts an item from comparison; the archive's version of that item is then
taken on trust ("believed"). If the claimed difference should be visible but nothing
differs, the claim is refuted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

from .. import json_text
from ..errors import InvalidArgument
from ..formats.json_fields import from_json, to_json
from .differences import Aspect, Difference
from .findings import Excuse, ExcuseKind, Finding, Outcome, Topic
from .frame_similarity import (
    OTHER_BUILD,
    OTHER_CPU,
    OTHER_ENCODER,
    OTHER_RENDERER,
    Limits,
    Similarity,
)

_Allowed: TypeAlias = Mapping[Aspect, float | Limits]

# Between MuJoCo 3.17 and 4.0, and with and without the CPU's FMA, a step of a model
# whose bodies touch as spheres, capsules and planes differs by 2e-12. Contacts that are
# computed iteratively (boxes, meshes, height fields) jump: by 2e-7 without FMA, and by
# 2.5e-3 between major versions. Velocities are differences divided by a time, and
# rewards depend on them.
_NEAR: Final[_Allowed] = {Aspect.STATE: 1e-6, Aspect.DERIVED: 1e-4}
_OTHER_MAJOR: Final[_Allowed] = {Aspect.STATE: 1e-2, Aspect.DERIVED: 1e-2}
# For sums computed in a different order.
_ROUNDED: Final[_Allowed] = {Aspect.STATE: 1e-9, Aspect.DERIVED: 1e-6}
_REDRAWN: Final[_Allowed] = {Aspect.HASH: math.inf, Aspect.ENCODED: math.inf}
_RESTORED: Final[_Allowed] = {Aspect.STORED: math.inf}
_RECOMPILED: Final[_Allowed] = {Aspect.SOLVER: math.inf, Aspect.MODEL: math.inf}
_ALIKE: Final[_Allowed] = {**_REDRAWN, **_RESTORED, Aspect.PICTURE: OTHER_ENCODER}


@dataclass(frozen=True)
class _Rule:
    """The effects of an excuse.

    Attributes:
        kind: the kind of the excuse.
        costs: how the excuse weakens the comparison, as a clause.
        allows: the largest allowed differences, keyed by aspect.
        fed: topics whose values were copied from the archive into the recreated run.
            Equality proves nothing there, and a difference is not excused.
    """

    kind: ExcuseKind
    costs: str
    allows: _Allowed = field(default_factory=dict)
    fed: Sequence[Topic] = ()


# Every difference in its items is believed.
_ENVIRONMENT: Final = "environment"
_STEPS: Final = "steps and rewards are compared within a tolerance"
_BY_NAME: Final[Mapping[str, _Rule]] = {
    "mujoco": _Rule(
        ExcuseKind.VERSION,
        f"{_STEPS}, and compiled models are believed",
        {**_ALIKE, **_RECOMPILED, **_NEAR},
    ),
    # From one state to the next, MuJoCo 4.0 against 3.17, in 3,600 random steps each of
    # Gymnasium's Ant and Humanoid: Ant's quaternions differed by 5e-3 and velocities by
    # 0.53 at most, its rewards by 0.051 and returns by 1.5e-3; Humanoid's by less. Ant
    # observes contact forces from -1 to 1.
    "rk4": _Rule(
        ExcuseKind.VERSION,
        "rotations of free bodies are compared within a wide tolerance",
        {
            Aspect.STATE: 0.05,
            Aspect.VELOCITY: 1.0,
            Aspect.DERIVED: 0.1,
            Aspect.SUMMED: 0.02,
            Aspect.OBSERVED: 2.0,
        },
    ),
    "machine": _Rule(
        ExcuseKind.HARDWARE,
        _STEPS,
        {**_ALIKE, **_RECOMPILED, **_NEAR, Aspect.PICTURE: OTHER_CPU},
    ),
    "gl": _Rule(
        ExcuseKind.HARDWARE,
        "frames are compared within a tolerance, and their hashes are believed",
        {**_ALIKE, Aspect.PICTURE: OTHER_RENDERER},
    ),
    "ffmpeg": _Rule(
        ExcuseKind.VERSION,
        "frames in the files are compared within a tolerance",
        # Frames are hashed before they are encoded.
        {a: limit for a, limit in _ALIKE.items() if a is not Aspect.HASH},
    ),
    **dict.fromkeys(
        ("numpy", "gymnasium", "gymnasium-robotics", "dm-control"),
        _Rule(
            ExcuseKind.VERSION,
            "initial states and rewards are compared within a tolerance",
            {**_ROUNDED, **_RESTORED},
        ),
    ),
    "mjrec": _Rule(ExcuseKind.VERSION, "descriptions are believed", _RESTORED),
    _ENVIRONMENT: _Rule(
        ExcuseKind.CODE, "its initial state, physics, rewards and videos are believed"
    ),
    "wrappers": _Rule(
        ExcuseKind.CODE,
        "its changes to actions, rewards and episode ends are believed",
        {Aspect.OBSERVED: math.inf},
        fed=(Topic.REWARDS,),
    ),
    **dict.fromkeys(
        ("schedule", "rule"),
        _Rule(
            ExcuseKind.CODE,
            "its choice of episodes is believed",
            fed=(Topic.SELECTION,),
        ),
    ),
    "actions not kept": _Rule(
        ExcuseKind.EVENT,
        "returns and episode ends are believed",
        fed=(Topic.REWARDS, Topic.BEGINNING, Topic.PHYSICS),
    ),
    "unseeded beginning": _Rule(
        ExcuseKind.EVENT, "its initial state is believed", fed=(Topic.BEGINNING,)
    ),
    # An encoder's death may not be noticed until the end, and the order of the keys
    # depends on when it is noticed.
    "broken video": _Rule(
        ExcuseKind.EVENT,
        "the frame at which it was cut short is believed",
        _RESTORED,
        fed=(Topic.VIDEOS,),
    ),
    **dict.fromkeys(
        ("kill", "early reset", "exception"),
        _Rule(ExcuseKind.EVENT, "its end is believed", fed=(Topic.REWARDS,)),
    ),
    "fault": _Rule(
        ExcuseKind.EVENT, "its end, or all of it, is believed", fed=(Topic.REWARDS,)
    ),
}
# Claims that can change the numbers of a step.
NUMERIC: Final = (
    *("mujoco", "machine", "numpy", "gymnasium", "gymnasium-robotics", "dm-control"),
    _ENVIRONMENT,
)
_ANY_VERSION: Final = _Rule(
    ExcuseKind.VERSION, "only the version itself is believed", _RESTORED
)
_DESCRIPTIONS: Final = ("README.md", "CITATION.cff", "ro-crate-metadata.json")
_NOTED: Final = (Aspect.CLAIM, Aspect.STORED, Aspect.ENCODED)
# The ways in which numbers computed by other code can differ.
COMPUTED: Final = (Aspect.STATE, Aspect.VELOCITY, Aspect.DERIVED, Aspect.SUMMED)
# For each aspect, the aspect whose limit applies if an excuse sets none.
_WIDER: Final = {
    Aspect.VELOCITY: Aspect.STATE,
    Aspect.SUMMED: Aspect.DERIVED,
    Aspect.OBSERVED: Aspect.DERIVED,
}
# Why items that have no tolerance are believed.
_BELIEVED: Final = {
    Aspect.SOLVER: "it is only the solver's starting point, and the result is the same",
    Aspect.MODEL: "it was compiled elsewhere",
    Aspect.HASH: "they were rendered elsewhere",
}
_FAMILIES: Final = ("llvmpipe", "softpipe", "nvidia", "amd", "radeon", "intel", "apple")
# The name of a file in the folder of a recreated run.
_NOTES: Final = "maker.json"


def excuse_of(name: str, claimed: str, here: str = "", *items: str) -> Excuse:
    """Return the excuse with the given name.

    Args:
        name: the name of a rule, or of a package without its own rule.
        claimed: the archive's value.
        here: the reader's value.
        items: the items that the excuse is claimed for; the whole archive if empty.
    """
    kind, costs = _rule(name).kind, _rule(name).costs
    return Excuse(
        kind=kind, name=name, claimed=claimed, here=here, items=items, costs=costs
    )


def note(
    item: str, excuse: str, reason: str, *, count: int = 1, unit: str = "episode"
) -> Finding:
    """Return a note on a fact that could not be recreated and had to be believed.

    Args:
        item: "episode 27 of 0.4711" or "recording 0.4711".
        excuse: the name of the excuse that claims it.
        reason: a clause with the reason and the fact that is believed.
        count: number of units that the note covers.
        unit: the unit of `count`.
    """
    topic = next(iter(_rule(excuse).fed), Topic.FILES)
    return Finding(
        topic, item, Outcome.BELIEVED, reason, excuse=excuse, count=count, unit=unit
    )


def write_notes(folder: Path, notes: Iterable[Finding]) -> None:
    """Write notes next to a recreated run, for the process that compares it."""
    (folder / _NOTES).write_text(json_text.dumps([to_json(each) for each in notes]))


def read_notes(folder: Path) -> list[Finding]:
    """Return the notes in a folder, or an empty list if it has none."""
    path = folder / _NOTES
    said = json_text.loads(path.read_text()) if path.exists() else []
    return [from_json(Finding, each) for each in said]


def noted_excuse(note: Finding) -> Excuse:
    """Return the excuse that a note claims."""
    name = str(note.excuse)
    # For code, the reason contains the name of the code.
    is_stated = _rule(name).kind is not ExcuseKind.EVENT
    return excuse_of(name, note.reason if is_stated else "", "", note.item)


def is_fed(excuse: str, topic: Topic | None = None) -> bool:
    """Return whether an excuse covers values copied from the archive (of `topic`)."""
    fed = _rule(excuse).fed
    return bool(fed) if topic is None else topic in fed


def merged(excuses: Iterable[Excuse]) -> tuple[Excuse, ...]:
    """Merge excuses with the same name and values into one for all of their items."""
    groups: dict[tuple[str, str, str], list[Excuse]] = {}
    for each in excuses:
        groups.setdefault((each.name, each.claimed, each.here), []).append(each)
    return tuple(map(_merged, groups.values()))


def _merged(same: list[Excuse]) -> Excuse:
    # An excuse without items applies to the whole archive.
    is_of_all = not all(each.items for each in same)
    items = dict.fromkeys(item for each in same for item in each.items)
    return dataclasses.replace(same[0], items=() if is_of_all else tuple(items))


def applicable(excuses: Iterable[Excuse]) -> tuple[Excuse, ...]:
    """Drop excuses that need two major MuJoCo versions if only one was used."""
    known = tuple(excuses)
    others = {
        item
        for each in known
        if each.name == "mujoco" and _major(each.claimed) != _major(each.here)
        for item in each.items
    }
    return tuple(e for e in known if e.name != "rk4" or not others.isdisjoint(e.items))


def with_allowed(excuses: Iterable[Excuse], allow: Iterable[str]) -> tuple[Excuse, ...]:
    """Return the excuses, with those that the reader accepts marked as allowed.

    Args:
        excuses: the claimed excuses.
        allow: the accepted excuses as "NAME=VALUE". The value is a part of the claimed
            value, or "any".

    Raises:
        InvalidArgument: an item of `allow` lacks a name or a value.
    """
    taken = []
    for text in allow:
        name, _, value = text.partition("=")
        if not name.strip() or not value.strip():
            raise InvalidArgument(
                f"allow takes an excuse's name and value, for example "
                f'"gl=NVIDIA H100", got {text!r}.'
            )
        taken.append((name.strip(), value.strip().lower()))
    return tuple(
        dataclasses.replace(
            excuse,
            allowed=any(
                name == excuse.name
                and (value == "any" or value in excuse.claimed.lower())
                for name, value in taken
            ),
        )
        for excuse in excuses
    )


def outcome_under(excuse: Excuse, found: Difference) -> Outcome | None:
    """Return a difference's outcome under an excuse; None if it is not allowed."""
    aspect = found.aspect
    if excuse.name == _ENVIRONMENT:
        return Outcome.BELIEVED
    if aspect is Aspect.CLAIM:
        return Outcome.NOTED if found.claim == excuse.name else None
    if aspect is Aspect.EXACT:
        is_described = excuse.name == "mjrec" and found.file in _DESCRIPTIONS
        return Outcome.BELIEVED if is_described else None
    allows = _allows(excuse)
    if aspect not in allows:
        aspect = _WIDER.get(aspect, aspect)
    limit = allows.get(aspect)
    if limit is None or not _is_within(found, limit):
        return None
    if aspect in _NOTED:
        return Outcome.NOTED
    return (
        Outcome.WITHIN_TOLERANCE
        if aspect in (*COMPUTED, Aspect.PICTURE)
        else Outcome.BELIEVED
    )


def finding_under(
    excuse: Excuse | None, found: Difference, outcome: Outcome
) -> Finding:
    """Return the finding for a difference with the given outcome."""
    figures, reason = dict(found.figures), found.reason
    if outcome is not Outcome.BELIEVED:
        if found.size is not None:
            figures["maximum"] = found.size
    elif excuse is not None:
        reason = _BELIEVED.get(found.aspect, excuse.costs)
    return Finding(
        found.topic,
        found.item,
        outcome,
        reason,
        excuse=excuse.name if excuse else None,
        count=found.count,
        unit=found.unit,
        figures=figures,
    )


def is_same_family(excuse: Excuse) -> bool:
    """Return whether the claimed renderer and the reader's are from the same vendor."""
    return _family(excuse.claimed) == _family(excuse.here)


def _allows(excuse: Excuse) -> _Allowed:
    allows = _rule(excuse.name).allows
    if excuse.name == "mujoco" and _major(excuse.claimed) != _major(excuse.here):
        return {**allows, **_OTHER_MAJOR}
    if excuse.name == "gl" and is_same_family(excuse):
        return {**allows, Aspect.PICTURE: OTHER_BUILD}
    return allows


def _is_within(found: Difference, limit: float | Limits) -> bool:
    if not isinstance(limit, Limits):
        return math.isinf(limit) or (found.size is not None and found.size <= limit)
    figures = found.figures
    is_shadow = 0 < figures["shadow"] <= limit.shadow
    suffix = "_lit" if is_shadow and figures["patch"] <= limit.patch else ""
    names = (f"{name}{suffix}" for name in Similarity._fields)
    return limit.strain(Similarity(*(figures[name] for name in names))) <= 1


def _rule(name: str) -> _Rule:
    return _BY_NAME.get(name, _ANY_VERSION)


def _major(version: str) -> str:
    return version.partition(".")[0]


def _family(renderer: str) -> str:
    """Return the vendor of a renderer if known, otherwise the whole name."""
    name = renderer.lower()
    return next((family for family in _FAMILIES if family in name), name)

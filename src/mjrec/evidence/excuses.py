# SPDX-License-Identifier: Apache-2.0
"""Excuses: claims that allow certain differences, and tests of these claims.

The exact comparison always comes first. An excuse applies to the recordings, episodes
or files that it is claimed for, as its rule below defines: it widens a finite
tolerance, or excludes an item, which is then believed. If the claimed difference should
be visible but nothing differs, the claim is refuted.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from ..errors import InvalidArgument
from .differences import Aspect, Difference, Place, Same
from .findings import Excuse, ExcuseKind, Finding, Outcome, Topic
from .frame_similarity import (
    OTHER_BUILD,
    OTHER_CPU,
    OTHER_ENCODER,
    OTHER_RENDERER,
    Limits,
    Similarity,
)
from .notes import Note

_Allowed: TypeAlias = Mapping[Aspect, float | Limits]

# Between MuJoCo 3.17 and 4.0, and with and without the CPU's FMA, a step of a model
# whose bodies touch as spheres, capsules and planes differs by 2e-12. Contacts that are
# found by iterating (boxes, meshes, height fields) jump: by 2e-7 without FMA, by 2.5e-3
# between major versions. Velocities are differences divided by a time, and rewards
# depend on them.
_NEAR: Final[_Allowed] = {Aspect.STATE: 1e-6, Aspect.DERIVED: 1e-4}
_OTHER_MAJOR: Final[_Allowed] = {Aspect.STATE: 1e-2, Aspect.DERIVED: 1e-2}
# Sums in a different order.
_ROUNDED: Final[_Allowed] = {Aspect.STATE: 1e-9, Aspect.DERIVED: 1e-6}
_REDRAWN: Final[_Allowed] = {Aspect.HASH: math.inf, Aspect.ENCODED: math.inf}
_RESTORED: Final[_Allowed] = {Aspect.STORED: math.inf}
_RECOMPILED: Final[_Allowed] = {Aspect.SOLVER: math.inf, Aspect.MODEL: math.inf}
_ALIKE: Final[_Allowed] = {**_REDRAWN, **_RESTORED, Aspect.PICTURE: OTHER_ENCODER}


@dataclass(frozen=True, kw_only=True)
class _Rule:
    """The effects of an excuse.

    Attributes:
        kind: the kind of the excuse.
        costs: what the excuse weakens, as a clause.
        allows: the largest allowed differences, by aspect.
        excludes: topics in which every difference is believed.
        fed: topics whose values were copied from the archive into the recreated run.
            Equality proves nothing there, and a difference is not excused.
    """

    kind: ExcuseKind
    costs: str
    allows: _Allowed = field(default_factory=dict)
    excludes: Sequence[Topic] = ()
    fed: Sequence[Topic] = ()


_STEPS: Final = "steps and rewards are compared within a tolerance"
_BY_NAME: Final[Mapping[str, _Rule]] = {
    "mujoco": _Rule(
        kind=ExcuseKind.VERSION,
        costs=f"{_STEPS}, and compiled models are believed",
        allows={**_ALIKE, **_RECOMPILED, **_NEAR},
    ),
    # Quaternions differ by up to 0.1 in Gymnasium's Ant.
    "rk4": _Rule(
        kind=ExcuseKind.VERSION,
        costs="rotations of free bodies are compared within a wide tolerance",
        allows={Aspect.STATE: 0.25, Aspect.DERIVED: 0.25},
    ),
    "machine": _Rule(
        kind=ExcuseKind.HARDWARE,
        costs=_STEPS,
        allows={**_ALIKE, **_RECOMPILED, **_NEAR, Aspect.PICTURE: OTHER_CPU},
    ),
    "gl": _Rule(
        kind=ExcuseKind.HARDWARE,
        costs="frames are compared within a tolerance, and their hashes are believed",
        allows={**_ALIKE, Aspect.PICTURE: OTHER_RENDERER},
    ),
    "ffmpeg": _Rule(
        kind=ExcuseKind.VERSION,
        costs="frames in the files are compared within a tolerance",
        # Frames are hashed before they are encoded.
        allows={a: limit for a, limit in _ALIKE.items() if a is not Aspect.HASH},
    ),
    **dict.fromkeys(
        ("numpy", "gymnasium", "gymnasium-robotics", "dm-control"),
        _Rule(
            kind=ExcuseKind.VERSION,
            costs="beginnings and rewards are compared within a tolerance",
            allows={**_ROUNDED, **_RESTORED},
        ),
    ),
    "mjrec": _Rule(
        kind=ExcuseKind.VERSION,
        costs="descriptions are believed",
        allows=_RESTORED,
    ),
    "environment": _Rule(
        kind=ExcuseKind.CODE,
        costs="its beginning, physics, rewards and videos are believed",
        excludes=tuple(Topic),
    ),
    "wrappers": _Rule(
        kind=ExcuseKind.CODE,
        costs="its changes to actions, rewards and ends are believed",
        allows={Aspect.OBSERVED: math.inf},
        fed=(Topic.REWARDS,),
    ),
    **dict.fromkeys(
        ("schedule", "rule", "step_trigger"),
        _Rule(
            kind=ExcuseKind.CODE,
            costs="its choice of episodes is believed",
            fed=(Topic.SELECTION,),
        ),
    ),
    "actions not kept": _Rule(
        kind=ExcuseKind.EVENT,
        costs="returns and ends are believed",
        fed=(Topic.REWARDS, Topic.BEGINNING, Topic.PHYSICS),
    ),
    "unseeded beginning": _Rule(
        kind=ExcuseKind.EVENT,
        costs="its initial state is believed",
        fed=(Topic.BEGINNING,),
    ),
    "broken video": _Rule(
        kind=ExcuseKind.EVENT,
        costs="where it breaks off is believed",
        fed=(Topic.VIDEOS,),
    ),
    **dict.fromkeys(
        ("kill", "early reset", "exception", "fault"),
        _Rule(
            kind=ExcuseKind.EVENT,
            costs="its end is believed",
            fed=(Topic.REWARDS,),
        ),
    ),
}
# Claims that can change the numbers of a step.
NUMERIC: Final = (
    *("mujoco", "machine", "numpy", "gymnasium", "gymnasium-robotics", "dm-control"),
    "environment",
)
_ANY_VERSION: Final = _Rule(
    kind=ExcuseKind.VERSION,
    costs="only the version itself is believed",
    allows=_RESTORED,
)
_DESCRIPTIONS: Final = ("README.md", "CITATION.cff", "ro-crate-metadata.json")
_OUTCOMES: Final = {
    Aspect.CLAIM: Outcome.NOTED,
    Aspect.STORED: Outcome.NOTED,
    Aspect.ENCODED: Outcome.NOTED,
    Aspect.STATE: Outcome.WITHIN_TOLERANCE,
    Aspect.DERIVED: Outcome.WITHIN_TOLERANCE,
    Aspect.PICTURE: Outcome.WITHIN_TOLERANCE,
}
# Why items are believed that have no tolerance.
_BELIEVED: Final = {
    Aspect.SOLVER: "it only starts the solver, which reaches the same result",
    Aspect.MODEL: "it was compiled elsewhere",
    Aspect.HASH: "they were rendered elsewhere",
}
# The largest share of frames that may be bitwise equal: with another rasterizer, few;
# with the same one on another CPU, those that rounding did not change.
_MOST_EQUAL_FRAMES: Final = {"gl": 0.5, "machine": 0.8}
_ELSEWHERE: Final = (ExcuseKind.VERSION, ExcuseKind.HARDWARE)
_FAMILIES: Final = ("llvmpipe", "softpipe", "nvidia", "amd", "radeon", "intel", "apple")


def excuse_of(name: str, claimed: str, here: str = "", *items: str) -> Excuse:
    """Return the excuse with a name.

    Args:
        name: the name of a rule, or of a package without its own rule.
        claimed: the archive's value.
        here: the reader's value.
        items: the items that it is claimed for. The whole archive if empty.
    """
    rule = _BY_NAME.get(name, _ANY_VERSION)
    return Excuse(
        kind=rule.kind,
        name=name,
        claimed=claimed,
        here=here,
        items=items,
        costs=rule.costs,
    )


def merged(excuses: Iterable[Excuse]) -> tuple[Excuse, ...]:
    """Merge excuses with the same name and values into one for all their items."""
    found: dict[tuple[str, str, str], Excuse] = {}
    items: dict[tuple[str, str, str], dict[str, None]] = {}
    of_all = set()
    for excuse in excuses:
        key = excuse.name, excuse.claimed, excuse.here
        found.setdefault(key, excuse)
        items.setdefault(key, {}).update(dict.fromkeys(excuse.items))
        if not excuse.items:
            of_all.add(key)
    return tuple(
        dataclasses.replace(each, items=() if key in of_all else tuple(items[key]))
        for key, each in found.items()
    )


def applicable(excuses: Iterable[Excuse]) -> tuple[Excuse, ...]:
    """Return excuses without those that require a different major MuJoCo."""
    known = tuple(excuses)
    others = {
        item
        for each in known
        if each.name == "mujoco" and _major(each.claimed) != _major(each.here)
        for item in each.items
    }
    return tuple(e for e in known if e.name != "rk4" or not others.isdisjoint(e.items))


def with_allowed(excuses: Iterable[Excuse], allow: Iterable[str]) -> tuple[Excuse, ...]:
    """Return excuses, with those that the reader accepts marked as allowed.

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


class Trial:
    """Tests excuses against all equal and all different items.

    Args:
        excuses: the claimed excuses.
    """

    def __init__(self, excuses: Sequence[Excuse]) -> None:
        self._excuses = excuses
        self._scopes = [frozenset(excuse.items) for excuse in excuses]
        self._used: Counter[int] = Counter()
        # By excuse and unit.
        self._equal: Counter[tuple[int, str]] = Counter()
        self._other: Counter[tuple[int, str]] = Counter()

    def same(self, place: Same) -> bool:
        """Count an equal item; return True if it was fed in and so proves nothing."""
        is_fed = False
        for index in self._reaching(place):
            self._equal[index, place.unit] += place.count
            is_fed |= place.topic in _rule(self._excuses[index]).fed
        return is_fed

    def judge(self, found: Difference) -> Finding | None:
        """Return the finding for a difference; None if it need not be reported."""
        if found.aspect is Aspect.STATEMENT:
            return None
        for index in self._reaching(found):
            excuse = self._excuses[index]
            outcome = _outcome(excuse, found)
            if outcome is None:
                continue
            self._other[index, found.unit] += found.count
            if outcome is not Outcome.NOTED:
                self._used[index] += found.count
            return _finding(found, outcome, excuse)
        return _finding(found, Outcome.DIFFERENT, None)

    def use(self, name: str) -> None:
        """Mark the excuses with a name as used."""
        for index, excuse in enumerate(self._excuses):
            self._used[index] += excuse.name == name

    @property
    def excuses(self) -> tuple[Excuse, ...]:
        """The used and refuted excuses, and all those of versions and hardware."""
        tried = (
            dataclasses.replace(
                excuse,
                is_needed=self._used[index] > 0,
                refuted=self._refutation(index) is not None,
            )
            for index, excuse in enumerate(self._excuses)
        )
        return tuple(
            excuse
            for excuse in tried
            if excuse.is_needed or excuse.refuted or excuse.kind in _ELSEWHERE
        )

    def refutations(self) -> Iterator[Finding]:
        """Yield a finding for each refuted claim."""
        for index, excuse in enumerate(self._excuses):
            reason = self._refutation(index)
            if reason is not None:
                yield Finding(
                    topic=Topic.IDENTITY,
                    item=", ".join(excuse.items[:3]),
                    outcome=Outcome.DIFFERENT,
                    reason=f"{excuse.name} is claimed to be {excuse.claimed} and is "
                    f"{excuse.here} here, but {reason}",
                    unit="claim",
                )

    def _reaching(self, place: Place) -> Iterator[int]:
        scopes = place.scopes
        for index, items in enumerate(self._scopes):
            if not items or not items.isdisjoint(scopes):
                yield index

    def _refutation(self, index: int) -> str | None:
        """Return why a claimed difference is refuted; None if it is not."""
        excuse, equal = self._excuses[index], self._equal
        frames, videos = equal[index, "frame"], equal[index, "encoding"]
        if excuse.name == "mujoco" and equal[index, "compiled model"]:
            return "the compiled model was written by the same version"
        if excuse.name == "ffmpeg" and videos and self._other[index, "encoding"]:
            return f"{videos} videos are equal byte for byte and others are not"
        others = self._other[index, "frame hash"]
        if excuse.name == "gl" and _family(excuse.claimed) == _family(excuse.here):
            return None
        if excuse.name == "machine" and not others:
            # It may be invisible: no step of the half cheetah depends on the CPU.
            return None
        most = _MOST_EQUAL_FRAMES.get(excuse.name)
        if frames and most is not None and frames >= most * (frames + others):
            return f"{frames} frames are equal bit for bit"
        return None


def believed(note: Note) -> tuple[Excuse, Finding | None]:
    """Return a maker's note as an excuse, and a finding for what is believed.

    The finding is None if the excuse matters only for differences.
    """
    name, item, reason = note.excuse, note.item, note.reason
    rule = _BY_NAME.get(name)
    # For code, the reason names it.
    is_stated = rule is not None and rule.kind is not ExcuseKind.EVENT
    excuse = excuse_of(name, reason if is_stated else "", "", item)
    if rule is not None and not rule.fed:
        return excuse, None
    if rule is None:
        excuse = dataclasses.replace(excuse, kind=ExcuseKind.EVENT, costs=reason)
    finding = Finding(
        topic=rule.fed[0] if rule else Topic.FILES,
        item=item,
        outcome=Outcome.BELIEVED,
        reason=reason,
        excuse=name,
        count=note.count,
        unit=note.unit,
    )
    return excuse, finding


def _outcome(excuse: Excuse, found: Difference) -> Outcome | None:
    """Return a difference's outcome under an excuse; None if it is not allowed."""
    rule = _rule(excuse)
    if found.topic in rule.excludes:
        return Outcome.BELIEVED
    if found.aspect is Aspect.CLAIM:
        return Outcome.NOTED if found.claim == excuse.name else None
    if found.aspect is Aspect.EXACT:
        is_described = excuse.name == "mjrec" and found.file in _DESCRIPTIONS
        return Outcome.BELIEVED if is_described else None
    allows = _allows(excuse, rule)
    limit = allows.get(found.aspect)
    aspect = found.aspect
    if limit is None and aspect is Aspect.OBSERVED:
        aspect, limit = Aspect.DERIVED, allows.get(Aspect.DERIVED)
    if limit is None:
        return None
    if isinstance(limit, Limits):
        is_within = _is_alike(found.figures, limit)
    else:
        is_within = math.isinf(limit) or (
            found.size is not None and found.size <= limit
        )
    return _OUTCOMES.get(aspect, Outcome.BELIEVED) if is_within else None


def _allows(excuse: Excuse, rule: _Rule) -> _Allowed:
    if excuse.name == "mujoco" and _major(excuse.claimed) != _major(excuse.here):
        return {**rule.allows, **_OTHER_MAJOR}
    if excuse.name == "gl" and _family(excuse.claimed) == _family(excuse.here):
        return {**rule.allows, Aspect.PICTURE: OTHER_BUILD}
    return rule.allows


def _is_alike(figures: Mapping[str, float], limits: Limits) -> bool:
    suffix = "_lit" if 0 < figures["shadow"] <= limits.shadow else ""
    names = (f"{name}{suffix}" for name in Similarity._fields)
    return limits.strain(Similarity(*(figures[name] for name in names))) <= 1


def _finding(found: Difference, outcome: Outcome, excuse: Excuse | None) -> Finding:
    figures = dict(found.figures)
    reason, is_believed = found.reason, outcome is Outcome.BELIEVED
    if excuse is not None and is_believed:
        reason = _BELIEVED.get(found.aspect, excuse.costs)
    if found.size is not None and not is_believed:
        figures["maximum"] = found.size
    return Finding(
        topic=found.topic,
        item=found.item,
        outcome=outcome,
        reason=reason,
        excuse=excuse.name if excuse else None,
        count=found.count,
        unit=found.unit,
        figures=figures,
    )


def _rule(excuse: Excuse) -> _Rule:
    return _BY_NAME.get(excuse.name, _ANY_VERSION)


def _major(version: str) -> str:
    return version.partition(".")[0]


def _family(renderer: str) -> str:
    """Return the vendor of a renderer if known, otherwise the whole name."""
    name = renderer.lower()
    return next((family for family in _FAMILIES if family in name), name)

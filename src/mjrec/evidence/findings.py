# SPDX-License-Identifier: Apache-2.0
"""The result of a verification: findings, excuses and one verdict.

A packed run is recreated from its inputs and compared with the archive, item by item.
Each finding is about one or more items. Each excuse is a claim in the archive that
allows some items to differ from the recreated ones.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from ..formats.json_fields import to_json

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


class Level(enum.StrEnum):
    """The depth of a verification; each level includes those before it."""

    FILES = "files"
    STATS = "stats"
    PHYSICS = "physics"
    PIXELS = "pixels"


class Topic(enum.StrEnum):
    """The topics of a verification, in the order of their lines on the screen."""

    IDENTITY = "identity"
    BEGINNING = "beginning"
    PHYSICS = "physics"
    REWARDS = "rewards and ends"
    SELECTION = "selection of episodes"
    VIDEOS = "videos shown"
    PICTURES = "pictures"
    FILES = "files"


class Outcome(enum.StrEnum):
    """The result of comparing an item with the recreated one."""

    RECREATED = "recreated"
    WITHIN_TOLERANCE = "within tolerance"
    BELIEVED = "believed"
    DIFFERENT = "different"
    # A remark about what was recreated; it does not lower the verdict.
    NOTED = "noted"


class ExcuseKind(enum.StrEnum):
    """The only reasons why an item may differ from the recreated one."""

    VERSION = "version"
    HARDWARE = "hardware"
    CODE = "code"
    EVENT = "event"


class Verdict(enum.StrEnum):
    """The result of a verification."""

    PASS = "PASS"
    PARTLY = "PARTLY"
    FAIL = "FAIL"

    @property
    def exit_status(self) -> int:
        """The exit status of `mjrec verify`."""
        return {Verdict.PASS: 0, Verdict.FAIL: 1, Verdict.PARTLY: 3}[self]


@dataclass(frozen=True)
class Finding:
    """One compared item, or several with the same result.

    Attributes:
        topic: the topic under which the finding is listed.
        item: "episode 27 of 0.4711", a file's name below `data/`, or "" for the whole
            run.
        outcome: the result of the comparison.
        reason: a clause. DIFFERENT: the place, the archive's value and the recreated
            value. BELIEVED: why the item was not recreated.
        excuse: name of the excuse that allows the difference; None if there is none.
        count: number of units that the finding covers.
        unit: the unit of `count`: "episode", "step", "frame", "video", "file".
        figures: numbers for JSON, keyed by name: `maximum`, `tolerance`, `psnr` ...
        is_headline: whether it is shown next to the verdict (gaps, identical
            episodes).
    """

    topic: Topic
    item: str
    outcome: Outcome
    reason: str = ""
    _: KW_ONLY
    excuse: str | None = None
    count: int = 1
    unit: str = "file"
    figures: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    is_headline: bool = False


@dataclass(frozen=True, kw_only=True)
class Excuse:
    """A claim that allows some items to differ from the recreated ones.

    Attributes:
        kind: a different version, different hardware, code that the reader does not
            have, or an event from outside.
        name: "mujoco", "cpu", "gl", "environment", "unseeded beginning" ...
        claimed: the archive's value: "NVIDIA H100", "3.17.0", "episode 0 of 0.4711".
        here: the reader's value; "" if there is none.
        items: the items it applies to: infixes of recordings, files' names below
            `recordings/`, or "episode 27 of 0.4711"; empty for the whole archive.
        costs: a clause that says how it weakens the proof.
        is_needed: whether it allows a difference that was found.
        refuted: whether the difference that it claims should be visible, but nothing
            differs.
        allowed: whether the reader accepts it (`--allow`), so that it does not lower
            the verdict.
    """

    kind: ExcuseKind
    name: str
    claimed: str
    here: str = ""
    items: tuple[str, ...] = ()
    costs: str = ""
    is_needed: bool = True
    refuted: bool = False
    allowed: bool = False


@dataclass(frozen=True, kw_only=True)
class Verification:
    """The result of `mjrec.verify`.

    Attributes:
        path: the path given to `verify`.
        level: the level given to `verify`.
        findings: the findings, in the order of the comparison.
        excuses: the excuses that the archive claims.
        inputs: the inputs that are not the default, keyed by name.
        facts: versions, machine, the archive's sha256, the sample and its seed, and
            trusted environments.
    """

    path: Path
    level: Level
    findings: tuple[Finding, ...]
    excuses: tuple[Excuse, ...] = ()
    inputs: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    facts: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)

    @property
    def verdict(self) -> Verdict:
        """PASS, PARTLY or FAIL."""
        if self.failures or any(excuse.refuted for excuse in self.excuses):
            return Verdict.FAIL
        if self.level is Level.FILES and self.findings:
            return Verdict.PARTLY
        if not any(map(_is_proof, self.findings)):
            return Verdict.FAIL
        needed = [excuse for excuse in self.excuses if excuse.is_needed]
        allowed = {excuse.name for excuse in needed if excuse.allowed}
        # Allowing one of several claims with the same name does not allow the others.
        allowed -= {excuse.name for excuse in needed if not excuse.allowed}
        # Shallower levels do not check files and frames.
        is_whole = self.level is Level.PIXELS and all(
            finding.outcome in (Outcome.RECREATED, Outcome.NOTED)
            or finding.excuse in allowed
            for finding in self.findings
        )
        return Verdict.PASS if is_whole else Verdict.PARTLY

    @property
    def passed(self) -> bool:
        """Whether everything was recreated and matches or is allowed."""
        return self.verdict is Verdict.PASS

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The findings that contradict the archive."""
        return tuple(f for f in self.findings if f.outcome is Outcome.DIFFERENT)

    def as_json(self) -> dict[str, Any]:
        """Return the verification as a JSON object, with the verdict."""
        return {**to_json(self), "verdict": str(self.verdict)}


def _is_proof(finding: Finding) -> bool:
    """Return whether the finding confirms output of the environment or the renderer."""
    return finding.topic in _MADE and finding.outcome in (
        Outcome.RECREATED,
        Outcome.WITHIN_TOLERANCE,
    )


_MADE: Final = (Topic.PHYSICS, Topic.REWARDS, Topic.PICTURES)

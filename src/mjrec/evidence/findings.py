# SPDX-License-Identifier: Apache-2.0
"""What a verification says: findings, excuses and one verdict.

A packed run is recreated from its inputs and compared, item by item. Each finding is
about one or several items; each excuse is a claim of the archive that allows some of
them to be other than recreated.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from ..formats.dataclass_json import to_json

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


class Level(enum.StrEnum):
    """How deep a verification goes; each level includes those before it."""

    FILES = "files"
    STATS = "stats"
    PHYSICS = "physics"
    PIXELS = "pixels"

    @property
    def included(self) -> tuple[Level, ...]:
        """This level and those before it, in order."""
        levels = tuple(Level)
        return levels[: levels.index(self) + 1]


class Topic(enum.StrEnum):
    """What is proved: a line of the one screen each, in its order."""

    IDENTITY = "identity"
    BEGINNING = "beginning"
    PHYSICS = "physics"
    REWARDS = "rewards and ends"
    SELECTION = "selection of episodes"
    VIDEOS = "videos shown"
    PICTURES = "pictures"
    FILES = "files"


class Outcome(enum.StrEnum):
    """How an item compares with the recreated one."""

    RECREATED = "recreated"
    WITHIN_TOLERANCE = "within tolerance"
    BELIEVED = "believed"
    DIFFERENT = "different"
    # A remark about what was recreated; it does not lower the verdict.
    NOTED = "noted"


class ExcuseKind(enum.StrEnum):
    """Why an item need not come out again; there are no other reasons."""

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
        """What `mjrec verify` exits with."""
        return {Verdict.PASS: 0, Verdict.FAIL: 1, Verdict.PARTLY: 3}[self]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One compared item, or several alike.

    Attributes:
        topic: its line on the screen.
        item: "episode 27 of 0.4711", a file's name below `data/`, or "" for the whole.
        outcome: how it compares.
        reason: a clause. DIFFERENT: where, the archive's value, the recreated value.
            BELIEVED: why it was not recreated.
        excuse: name of the excuse that allows it. None if none was needed or applies.
        count: how many `unit` it stands for.
        unit: what is counted: "episode", "step", "frame", "video", "file".
        figures: numbers by name, for JSON: `maximum`, `tolerance`, `psnr` ...
        is_headline: shown beside the verdict: gaps, identical episodes.
    """

    topic: Topic
    item: str
    outcome: Outcome
    reason: str = ""
    excuse: str | None = None
    count: int = 1
    unit: str = "file"
    figures: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    is_headline: bool = False


@dataclass(frozen=True, kw_only=True)
class Excuse:
    """A claim that allows some items to be other than recreated.

    Attributes:
        kind: which of the three kinds (other versions or hardware; code that the
            reader does not have; events from outside).
        name: "mujoco", "cpu", "gl", "environment", "unseeded beginning" ...
        claimed: the archive's value: "NVIDIA H100", "3.17.0", "episode 0 of 0.4711".
        here: the reader's value; "" where there is none.
        items: what it applies to: infixes of recordings, files' names below
            `recordings/`, or "episode 27 of 0.4711"; empty for the whole archive.
        costs: what it takes away from the proof, a clause.
        is_needed: something differs that it allows.
        refuted: the difference that it claims ought to show, and nothing differs.
        allowed: the reader takes it (`--allow`), so that it does not lower the verdict.
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
        path: as given.
        level: as given.
        findings: in the order of the comparison.
        excuses: those that were claimed.
        inputs: inputs that are not default, by name.
        facts: versions, machine, the archive's sha256, sample and its seed, trusted
            environments.
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
        # Of several claims of one kind, the reader may take one only.
        allowed -= {excuse.name for excuse in needed if not excuse.allowed}
        # Less deep levels leave files and frames out.
        is_whole = self.level is Level.PIXELS and all(
            finding.outcome in (Outcome.RECREATED, Outcome.NOTED)
            or finding.excuse in allowed
            for finding in self.findings
        )
        return Verdict.PASS if is_whole else Verdict.PARTLY

    @property
    def passed(self) -> bool:
        """Whether everything was recreated and is equal, or allowed."""
        return self.verdict is Verdict.PASS

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The findings that contradict the archive."""
        return tuple(f for f in self.findings if f.outcome is Outcome.DIFFERENT)

    def as_json(self) -> dict[str, Any]:
        """Return all of it as JSON has it."""
        return {**to_json(self), "verdict": str(self.verdict)}


def _is_proof(finding: Finding) -> bool:
    """Return whether something that the environment or the renderer gives came out."""
    return finding.topic in _MADE and finding.outcome in (
        Outcome.RECREATED,
        Outcome.WITHIN_TOLERANCE,
    )


_MADE: Final = (Topic.PHYSICS, Topic.REWARDS, Topic.PICTURES)

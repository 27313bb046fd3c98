# SPDX-License-Identifier: Apache-2.0
"""What a verification has found: one check after the other, each with its reason."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any


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


class Verdict(enum.StrEnum):
    """What became of a check."""

    PASS = "pass"
    FAIL = "fail"
    NOT_CHECKABLE = "not checkable"


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was checked.

    Attributes:
        level: the level it belongs to.
        claim: what was checked, as a clause that holds where the verdict is PASS: "the
            next recorded state follows from each recorded state".
        subject: what it was checked of: a file's name, "episode 27 of 0.4711", or ""
            for the whole.
        verdict: what became of it.
        reason: why, in a sentence's words without its full stop. Of a PASS: how far it
            goes ("bit for bit, 1000 steps"); of a FAIL: what was found where, and what
            was expected; of a NOT_CHECKABLE: what is missing, and how to get it.
        figures: numbers that go with it, by name, for JSON: `steps`, `median`, `p99`,
            `maximum`, `tolerance`, `psnr` ...
    """

    level: Level
    claim: str
    subject: str
    verdict: Verdict
    reason: str = ""
    figures: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a verification has found.

    Attributes:
        path: what was verified.
        level: how deep.
        checks: what was checked, in order.
        facts: what they were checked with: versions, fingerprint, the seed of the
            sample.
    """

    path: Path
    level: Level
    checks: tuple[Check, ...]
    facts: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def failures(self) -> tuple[Check, ...]:
        """The checks that failed."""
        return tuple(c for c in self.checks if c.verdict is Verdict.FAIL)

    @property
    def passed(self) -> bool:
        """Whether nothing failed; not being checkable is no failure, and no proof."""
        return not self.failures

    def count(self, verdict: Verdict) -> int:
        """Return how many checks have a verdict."""
        return sum(check.verdict is verdict for check in self.checks)

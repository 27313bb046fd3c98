# SPDX-License-Identifier: Apache-2.0
"""Many things of which one claim is made: a check for each that fails, and one for all.

A hundred thousand files that are as they should be are one line, and so are a hundred
thousand that are not: the first hundred are named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ..verification import Check, Level, Verdict

_MOST_NAMED = 100
_LONGEST_REASON = 1000


@dataclass
class Findings:
    """Gathers what was found of one claim.

    Attributes:
        level: that the claim belongs to.
        claim: as `Check` has it.
        looked_at: how many things so far.
        whole: what all these things are parts of; everything, if empty.
    """

    level: Level
    claim: str
    looked_at: int = 0
    whole: str = ""
    _failures: list[tuple[str, str]] = field(default_factory=list)
    _unknown: dict[str, int] = field(default_factory=dict)
    _failed: int = 0

    def look(self, subject: str, *objections: str | None) -> None:
        """Note a thing that was looked at.

        Args:
            subject: what it is called.
            objections: what is wrong with it; None where nothing is.
        """
        self.looked_at += 1
        for objection in filter(None, objections):
            self.fail(subject, objection)

    def fail(self, subject: str, reason: str) -> None:
        """Note what is wrong with a thing."""
        self._failed += 1
        if len(self._failures) < _MOST_NAMED:
            self._failures.append((subject, reason[:_LONGEST_REASON]))

    def cannot_tell(self, reason: str) -> None:
        """Note that of one thing, for this reason, nothing can be told."""
        reason = reason[:_LONGEST_REASON]
        if reason in self._unknown or len(self._unknown) < _MOST_NAMED:
            self._unknown[reason] = self._unknown.get(reason, 0) + 1

    def checks(self, *, passed: str = "", **figures: Any) -> Iterator[Check]:
        """Yield the checks that they amount to.

        Args:
            passed: how far it goes, where nothing has failed.
            figures: that go with the check of all.
        """
        for subject, reason in self._failures:
            yield self._check(Verdict.FAIL, reason, subject)
        more = self._failed - len(self._failures)
        if more:
            yield self._check(Verdict.FAIL, f"likewise {more} more", self.whole)
        for reason, count in self._unknown.items():
            yield self._check(Verdict.NOT_CHECKABLE, reason, self.whole, count=count)
        if self.looked_at and not self._failed:
            figures = {"count": self.looked_at, **figures}
            yield self._check(Verdict.PASS, passed, self.whole, **figures)

    def _check(
        self, verdict: Verdict, reason: str, subject: str, **figures: Any
    ) -> Check:
        return Check(
            level=self.level,
            claim=self.claim,
            subject=subject,
            verdict=verdict,
            reason=reason,
            figures=figures,
        )

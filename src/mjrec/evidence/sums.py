# SPDX-License-Identifier: Apache-2.0
"""Merging of findings with the same result for several items into one with a count."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final

from .differences import Same
from .findings import Finding, Outcome, Topic

_MOST_FAILURES: Final = 100


class Sums:
    """Counts findings with the same result for several items."""

    def __init__(self) -> None:
        self._sums: dict[tuple[Any, ...], Finding] = {}
        self._counts: Counter[tuple[Any, ...]] = Counter()
        self._failures: Counter[Topic] = Counter()

    def same(self, found: Same) -> None:
        """Count items that are equal."""
        self.add(
            Finding(
                topic=found.topic,
                item=found.item,
                outcome=Outcome.RECREATED,
                count=found.count,
                unit=found.unit,
            )
        )

    def add(self, finding: Finding) -> None:
        """Merge a finding with those for the same excuse, and keep the worst."""
        is_within = finding.outcome is Outcome.WITHIN_TOLERANCE
        reason = "" if is_within else finding.reason
        key = (finding.topic, finding.outcome, finding.excuse, finding.unit, reason)
        self._counts[key] += finding.count
        known = self._sums.setdefault(key, finding)
        worst = max(known, finding, key=lambda each: each.figures.get("maximum", 0.0))
        is_one = known.item == finding.item
        self._sums[key] = worst if is_one else dataclasses.replace(worst, item="")

    def fail(self, finding: Finding) -> bool:
        """Count a difference, and return whether to list it separately."""
        self._failures[finding.topic] += 1
        return self._failures[finding.topic] <= _MOST_FAILURES

    def __iter__(self) -> Iterator[Finding]:
        for key, finding in self._sums.items():
            yield dataclasses.replace(finding, count=self._counts[key])
        for topic, count in self._failures.items():
            if count > _MOST_FAILURES:
                yield Finding(
                    topic=topic,
                    item="",
                    outcome=Outcome.DIFFERENT,
                    reason="more places differ",
                    count=count - _MOST_FAILURES,
                    unit="place",
                )

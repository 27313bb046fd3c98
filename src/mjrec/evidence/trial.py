# SPDX-License-Identifier: Apache-2.0
"""Judgment of all equal and different items under the excuses, and the totals."""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, Final

from .differences import Aspect, Difference, Place, Same
from .excuses import (
    COMPUTED,
    NUMERIC,
    finding_under,
    is_fed,
    is_same_family,
    outcome_under,
)
from .findings import Excuse, ExcuseKind, Finding, Outcome, Topic

_MOST_FAILURES: Final = 100
# The largest credible share of bitwise equal frames. The same rasterizer on a CPU
# without AVX leaves any share equal: in 12 recordings, either no frame of a recording
# was equal, or no block of a frame differed by more than 4 levels.
_MOST_EQUAL_FRAMES: Final = 0.5
# Levels in the worst block. One pixel that differs by 64 levels gives 5.
_VISIBLE: Final = 8.0
_ELSEWHERE: Final = (ExcuseKind.VERSION, ExcuseKind.HARDWARE)


class Trial:
    """Judges all equal and different items, and tests the excuses against them.

    Findings with the same result for several items are merged into one with a count.

    Args:
        excuses: the claimed excuses.
    """

    def __init__(self, excuses: Sequence[Excuse]) -> None:
        self._excuses = excuses
        self._scopes = [frozenset(excuse.items) for excuse in excuses]
        self._used: Counter[int] = Counter()
        # Units of each recording, keyed by excuse and unit.
        self._equal: defaultdict[tuple[int, str], Counter[str]] = defaultdict(Counter)
        self._other: defaultdict[tuple[int, str], Counter[str]] = defaultdict(Counter)
        # Recordings whose frames differ visibly, keyed by excuse.
        self._visible: dict[int, set[str]] = {}
        self._sums: dict[tuple[Any, ...], Finding] = {}
        self._counts: Counter[tuple[Any, ...]] = Counter()
        self._failures: Counter[Topic] = Counter()
        self._is_other_code = False

    def believe(self, note: Finding) -> None:
        """Count a note, and mark the excuses with its name as used."""
        for index, excuse in enumerate(self._excuses):
            self._used[index] += excuse.name == note.excuse
        self._add(note)

    def take(self, found: Same | Difference | Finding) -> Finding | None:
        """Count a comparator's result; return a contradiction to list separately."""
        if isinstance(found, Same):
            is_proof = True
            for index in self._reaching(found):
                self._equal[index, found.unit][_recording(found)] += found.count
                # The item was copied from the archive, so it proves nothing.
                is_proof &= not is_fed(self._excuses[index].name, found.topic)
            if is_proof:
                count, unit, outcome = found.count, found.unit, Outcome.RECREATED
                self._add(
                    Finding(found.topic, found.item, outcome, count=count, unit=unit)
                )
            return None
        finding = self.judge(found) if isinstance(found, Difference) else found
        if finding is None:
            return None
        if isinstance(found, Finding) or finding.outcome is not Outcome.DIFFERENT:
            self._add(finding)
            return None
        self._is_other_code |= found.aspect in COMPUTED
        self._failures[finding.topic] += 1
        return finding if self._failures[finding.topic] <= _MOST_FAILURES else None

    def judge(self, found: Difference) -> Finding | None:
        """Return the finding for a difference; None if it need not be reported."""
        if found.aspect is Aspect.STATEMENT:
            return None
        for index in self._reaching(found):
            excuse = self._excuses[index]
            outcome = outcome_under(excuse, found)
            if outcome is None:
                continue
            recording = _recording(found)
            self._other[index, found.unit][recording] += found.count
            if found.figures.get("block", 0.0) > _VISIBLE:
                self._visible.setdefault(index, set()).add(recording)
            if outcome is not Outcome.NOTED:
                self._used[index] += found.count
            return finding_under(excuse, found, outcome)
        return finding_under(None, found, Outcome.DIFFERENT)

    def totals(self) -> Iterator[Finding]:
        """Yield the refuted claims, the merged findings, and remarks on them."""
        for index, excuse in enumerate(self._excuses):
            if (reason := self._refutation(index)) is not None:
                yield Finding(
                    Topic.IDENTITY,
                    ", ".join(excuse.items[:3]),
                    Outcome.DIFFERENT,
                    f"{excuse.name} is claimed to be {excuse.claimed} and is "
                    f"{excuse.here} here, but {reason}",
                    unit="claim",
                )
        for key, finding in self._sums.items():
            yield dataclasses.replace(finding, count=self._counts[key])
        for topic, count in self._failures.items():
            if (more := count - _MOST_FAILURES) > 0:
                reason, outcome = "more places differ", Outcome.DIFFERENT
                yield Finding(topic, "", outcome, reason, count=more, unit="place")
        if self._is_other_code and not any(e.name in NUMERIC for e in self.excuses):
            yield Finding(
                Topic.PHYSICS,
                "",
                Outcome.NOTED,
                "it claims the same versions and machine as here, so the code or the "
                "numbers must have been different",
                unit="verification",
                is_headline=True,
            )

    @property
    def excuses(self) -> tuple[Excuse, ...]:
        """The used and refuted excuses, and all excuses for versions and hardware."""
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

    def _add(self, finding: Finding) -> None:
        """Merge a finding with those for the same excuse, and keep the worst."""
        is_within = finding.outcome is Outcome.WITHIN_TOLERANCE
        reason = "" if is_within else finding.reason
        key = (finding.topic, finding.outcome, finding.excuse, finding.unit, reason)
        self._counts[key] += finding.count
        known = self._sums.setdefault(key, finding)
        worst = max(known, finding, key=lambda each: each.figures.get("maximum", 0.0))
        is_one = known.item == finding.item
        self._sums[key] = worst if is_one else dataclasses.replace(worst, item="")

    def _reaching(self, place: Place) -> Iterator[int]:
        scopes = place.scopes
        for index, items in enumerate(self._scopes):
            if not items or not items.isdisjoint(scopes):
                yield index

    def _refutation(self, index: int) -> str | None:
        """Return why a claimed difference is refuted; None if it is not."""
        excuse, encodings = self._excuses[index], (index, "encoding")
        if excuse.name == "mujoco" and self._equal[index, "compiled model"]:
            return "the compiled model was written by the same version"
        if (
            excuse.name == "ffmpeg"
            and self._equal[encodings]
            and self._other[encodings]
        ):
            return "some videos are equal byte for byte and others are not"
        recordings: Sequence[str | None] = [None] if excuse.name == "gl" else []
        if excuse.name == "machine" or (excuse.name == "gl" and is_same_family(excuse)):
            # What differs less may be rounding.
            recordings = sorted(self._visible.get(index, ()))
        for recording in recordings:
            frames = _number(self._equal[index, "frame"], recording)
            # Without all frames, there are no hashes.
            others = self._others("frame hash", recording)
            others = others or self._others("frame", recording)
            if frames and frames >= _MOST_EQUAL_FRAMES * (frames + others):
                where = "" if recording is None else f" of {recording}"
                return f"{frames} frames{where} are equal bit for bit"
        return None

    def _others(self, unit: str, recording: str | None) -> int:
        """Return the number of differing units under any excuse."""
        counts = (self._other[index, unit] for index in range(len(self._excuses)))
        return sum(_number(each, recording) for each in counts)


def _number(counts: Counter[str], recording: str | None) -> int:
    """Return the number of units of a recording, or of all of them."""
    return counts.total() if recording is None else counts[recording]


def _recording(place: Place) -> str:
    """Return the recording of an item; without one, its file."""
    return place.scopes[-2:][0]

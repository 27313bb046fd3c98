# SPDX-License-Identifier: Apache-2.0
"""What was measured, what it is compared with, and what was promised."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Promise:
    """A limit that a number is to keep.

    Attributes:
        bound: the limit itself is kept.
        is_least: the number is to be this or more, not this or less.
    """

    bound: float
    is_least: bool

    def is_kept_by(self, value: float) -> bool:
        """Return whether a number is on the right side."""
        return value >= self.bound if self.is_least else value <= self.bound

    def __str__(self) -> str:
        return f"{'≥' if self.is_least else '≤'} {self.bound:g}"


def at_least(bound: float) -> Promise:
    """Return the promise of this much or more."""
    return Promise(bound, is_least=True)


def at_most(bound: float) -> Promise:
    """Return the promise of this much or less."""
    return Promise(bound, is_least=False)


@dataclass(frozen=True)
class Reference:
    """What a result is compared with: measured in the same rounds, in the same unit.

    Attributes:
        name: in the table.
        samples: one for each round.
        is_ratio: the result is divided by it; else it is subtracted.
    """

    name: str
    samples: tuple[float, ...]
    is_ratio: bool = True

    def compare(self, value: float, reference: float) -> float:
        """Return a number of the result in terms of one of the reference."""
        if not self.is_ratio:
            return value - reference
        return value / reference if reference else math.nan


@dataclass(frozen=True, kw_only=True)
class Result:
    """One line of the table.

    Attributes:
        subject: what was worked on: an environment, a model.
        variant: how.
        unit: of the samples.
        samples: one for each round; none where it could not be measured.
        reference: None where the number stands for itself.
        promise: of the comparison, or of the number itself where there is none.
        note: what else there is to say, such as why it could not be measured.
    """

    subject: str
    variant: str
    unit: str
    samples: tuple[float, ...]
    reference: Reference | None = None
    promise: Promise | None = None
    note: str = ""

    @property
    def median(self) -> float:
        """The middle one of the samples."""
        return statistics.median(self.samples) if self.samples else math.nan

    @property
    def quartiles(self) -> tuple[float, float]:
        """Half of the samples lie between these."""
        return _quartiles(self.samples)

    @property
    def compared(self) -> float | None:
        """The comparison of the medians; None without a reference."""
        if self.reference is None or not self.samples:
            return None
        reference = statistics.median(self.reference.samples)
        return self.reference.compare(self.median, reference)

    @property
    def compared_quartiles(self) -> tuple[float, float] | None:
        """Half of the rounds' own comparisons lie between these."""
        if self.reference is None or not self.samples:
            return None
        pairs = zip(self.samples, self.reference.samples, strict=True)
        return _quartiles([self.reference.compare(*pair) for pair in pairs])

    @property
    def is_kept(self) -> bool | None:
        """Whether the promise holds; None where nothing is promised or measured."""
        if self.promise is None or not self.samples:
            return None
        value = self.median if self.reference is None else self.compared
        assert value is not None
        return self.promise.is_kept_by(value)

    def as_json(self) -> dict[str, Any]:
        """Return everything in what JSON can hold."""
        return {
            "subject": self.subject,
            "variant": self.variant,
            "unit": self.unit,
            "samples": list(self.samples),
            "median": self.median if self.samples else None,
            "quartiles": list(self.quartiles) if self.samples else None,
            "compared_with": self.reference and self.reference.name,
            "comparison": self.reference
            and ("ratio" if self.reference.is_ratio else "difference"),
            "compared": self.compared,
            "compared_quartiles": self.compared_quartiles
            and list(self.compared_quartiles),
            "promise": self.promise and str(self.promise),
            "kept": self.is_kept,
            "note": self.note,
        }


def _quartiles(values: Iterable[float]) -> tuple[float, float]:
    samples: Sequence[float] = list(values)
    if not samples:
        return math.nan, math.nan
    if len(samples) == 1:
        return samples[0], samples[0]
    first, _, third = statistics.quantiles(samples, n=4, method="inclusive")
    return first, third

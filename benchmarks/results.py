# SPDX-License-Identifier: Apache-2.0
"""Measured results, the references to compare them with, and promised limits."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Promise:
    """A promised limit for a number.

    Attributes:
        bound: the limit, which is itself allowed.
        is_least: whether `bound` is the smallest allowed number instead of the largest.
    """

    bound: float
    is_least: bool

    def is_kept_by(self, value: float) -> bool:
        """Return whether a number is within the limit."""
        return value >= self.bound if self.is_least else value <= self.bound

    def __str__(self) -> str:
        return f"{'≥' if self.is_least else '≤'} {self.bound:g}"


def at_least(bound: float) -> Promise:
    """Return a promise that a number is at least `bound`."""
    return Promise(bound, is_least=True)


def at_most(bound: float) -> Promise:
    """Return a promise that a number is at most `bound`."""
    return Promise(bound, is_least=False)


@dataclass(frozen=True)
class Reference:
    """A reference for a result, measured in the same rounds and in the same unit.

    Attributes:
        name: name to show in the table.
        samples: one sample per round.
        is_ratio: whether to divide the result by the reference. If false, the reference
            is subtracted from the result.
    """

    name: str
    samples: tuple[float, ...]
    is_ratio: bool = True

    def compare(self, value: float, reference: float) -> float:
        """Return the ratio or difference of a number and a reference number."""
        if not self.is_ratio:
            return value - reference
        return value / reference if reference else math.nan


@dataclass(frozen=True, kw_only=True)
class Result:
    """One line of the table.

    Attributes:
        subject: the subject of the measurement, such as an environment or a model.
        variant: name of the measured variant.
        unit: unit of the samples.
        samples: one sample per round; empty if the variant could not be measured.
        reference: the reference to compare with; None for no comparison.
        promise: the limit for the comparison, or for the number itself if there is no
            reference.
        note: a remark, such as the reason why the variant could not be measured.
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
        """The median of the samples."""
        return statistics.median(self.samples) if self.samples else math.nan

    @property
    def quartiles(self) -> tuple[float, float]:
        """The first and third quartiles of the samples."""
        return _quartiles(self.samples)

    @property
    def compared(self) -> float | None:
        """The comparison of the medians, or None without a reference."""
        if self.reference is None or not self.samples:
            return None
        reference = statistics.median(self.reference.samples)
        return self.reference.compare(self.median, reference)

    @property
    def compared_quartiles(self) -> tuple[float, float] | None:
        """The first and third quartiles of the comparisons of each round."""
        if self.reference is None or not self.samples:
            return None
        pairs = zip(self.samples, self.reference.samples, strict=True)
        return _quartiles([self.reference.compare(*pair) for pair in pairs])

    @property
    def is_kept(self) -> bool | None:
        """Whether the promise is kept; None without a promise or a measurement."""
        if self.promise is None or not self.samples:
            return None
        value = self.median if self.reference is None else self.compared
        assert value is not None
        return self.promise.is_kept_by(value)

    def as_json(self) -> dict[str, Any]:
        """Return the result as values that JSON can represent."""
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

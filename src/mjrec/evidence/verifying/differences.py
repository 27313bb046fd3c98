# SPDX-License-Identifier: Apache-2.0
"""How far what was made again is from what was recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..verification import Verdict
from .tolerances import Fit


class Differences:
    """Gathers the errors of rows of numbers, and remembers the first difference.

    Args:
        names: of the columns.

    Attributes:
        rows: how many were compared.
        differing: in how many of them a bit is another.
        first: the first of them: its number, the column's name, what is recorded and
            what was found; None without one. NaN is the same as NaN.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._errors: list[NDArray[np.float64]] = []
        self._worst = 0.0
        self.rows = 0
        self.differing = 0
        self.first: tuple[int, str, float, float] | None = None
        self.worst: tuple[int, str, float, float] | None = None

    def add(
        self,
        numbers: NDArray[np.int64],
        recorded: NDArray[np.float64],
        found: NDArray[np.float64],
    ) -> None:
        """Compare rows.

        Args:
            numbers: of the rows, `(n,)`: after how many steps each was recorded.
            recorded: `(n, m)`.
            found: `(n, m)`.
        """
        if not len(numbers):
            return
        self.rows += len(numbers)
        recorded = np.ascontiguousarray(recorded)
        found = np.ascontiguousarray(found)
        other = recorded.view(np.uint64) != found.view(np.uint64)
        if not other.any():
            self._errors.append(np.zeros(len(numbers)))
            return
        errors = _errors(recorded, found)
        errors[~other] = 0.0
        is_other = other.any(axis=1)
        self.differing += int(is_other.sum())
        if self.first is None:
            row = int(np.argmax(is_other))
            column = int(np.argmax(other[row]))
            self.first = self._place(numbers, recorded, found, row, column)
        if errors.max() >= self._worst:
            row, column = map(int, np.unravel_index(np.argmax(errors), errors.shape))
            self._worst = float(errors[row, column])
            self.worst = self._place(numbers, recorded, found, row, column)
        self._errors.append(errors.max(axis=1))

    @property
    def maximum(self) -> float:
        """The largest error."""
        return self._worst

    def figures(self) -> dict[str, Any]:
        """Return what a report shows: errors are the largest of each row."""
        errors = np.concatenate(self._errors) if self._errors else np.zeros(1)
        # NaN and infinity are no JSON.
        errors = np.minimum(np.nan_to_num(errors, nan=np.inf), np.finfo(float).max)
        return {
            "rows": self.rows,
            "differing": self.differing,
            "median": float(np.median(errors)),
            "p99": float(np.quantile(errors, 0.99, method="higher")),
            "maximum": float(errors.max()),
        }

    def _place(
        self,
        numbers: NDArray[np.int64],
        recorded: NDArray[np.float64],
        found: NDArray[np.float64],
        row: int,
        column: int,
    ) -> tuple[int, str, float, float]:
        return (
            int(numbers[row]),
            self._names[column],
            float(recorded[row, column]),
            float(found[row, column]),
        )


def judged(
    differences: Differences, fit: Fit, unit: str = "step"
) -> tuple[Verdict, str, dict[str, Any]]:
    """Return what comes of differences: verdict, reason and figures.

    Args:
        differences: of rows.
        fit: how far apart they may be.
        unit: what a row is called.
    """
    figures = {**differences.figures(), "tolerance": fit.tolerance}
    rows = _counted(differences.rows, unit)
    if differences.first is None:
        return Verdict.PASS, f"bit for bit, {rows}", figures
    if not fit.is_exact and differences.maximum <= fit.tolerance:
        reason = (
            f"{rows} within {fit.tolerance:g} of |x - y| / (1 + |x|), the largest "
            f"error is {differences.maximum:.2g}; {fit.why}"
        )
        return Verdict.PASS, reason, figures
    place = differences.first if fit.is_exact else differences.worst
    assert place is not None
    number, name, recorded, found = place
    wanted = "" if fit.is_exact else f", more than {fit.tolerance:g} apart ({fit.why})"
    reason = (
        f"after step {number} {name} is recorded as {recorded!r}, and is {found!r} "
        f"when made again{wanted}; {differences.differing} of {rows} differ"
    )
    if differences.maximum <= fit.limit:
        reason += f"; {fit.why_unsure}"
        return Verdict.NOT_CHECKABLE, reason, figures
    return Verdict.FAIL, reason, figures


def compared_columns(
    parts: Mapping[str, slice], *, with_warm_start: bool
) -> tuple[list[str], NDArray[np.bool_]]:
    """Return the names of the numbers of a state that are compared, and which it is.

    Args:
        parts: of the recorded rows, as `TrajectoryReader.columns` has them.
        with_warm_start: whether the solver's is one of them.
    """
    names = [
        part if part == "time" else f"{part}[{index}]"
        for part, columns in parts.items()
        for index in range(columns.stop - columns.start)
    ]
    compared = np.ones(len(names), bool)
    if "warmstart" in parts:
        compared[parts["warmstart"]] = with_warm_start
    kept = [name for name, is_kept in zip(names, compared, strict=True) if is_kept]
    return kept, compared


def _errors(
    recorded: NDArray[np.float64], found: NDArray[np.float64]
) -> NDArray[np.float64]:
    with np.errstate(all="ignore"):
        errors = np.abs(recorded - found) / (1 + np.abs(recorded))
    # What is no number is as far away as anything can be.
    return np.where(np.isfinite(errors), errors, np.inf)


def _counted(rows: int, unit: str) -> str:
    return f"{rows} {unit}" + "s" * (rows != 1)

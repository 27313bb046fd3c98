# SPDX-License-Identifier: Apache-2.0
"""Requirements that a comparison must meet, such as `IQM difference low > 0`."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from ..errors import InvalidArgument, UnknownName
from .comparing import OVERALL_FIGURES, TASK_FIGURES, Comparison
from .statistics import Estimate

_SIGNS: Final[dict[str, Callable[[float, float], bool]]] = {
    ">": operator.gt,
    ">=": operator.ge,
    "<": operator.lt,
    "<=": operator.le,
}
_NO_SCORES: Final = (
    ", because no task has the same score range in all evaluations: set one with "
    "mjrec evaluate --resume DIR --score-range TASK=LOW:HIGH"
)
_FORM: Final = re.compile(
    r"(?:(?P<task>.+):\s+)?(?P<figure>[^<>=:]+?)(?:\s+(?P<end>low|high))?"
    r"\s*(?P<sign>[<>]=?)\s*(?P<number>[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?)"
)


@dataclass(frozen=True)
class Requirement:
    """A requirement for a figure in a comparison.

    Attributes:
        text: the requirement as the user wrote it.
        task: name of the task. None means the figure across all tasks if there is one,
            otherwise each task separately.
        figure: the figure's name.
        end: `"low"` or `"high"` for an end of the figure's interval; None for the
            figure itself.
        sign: the comparison operator.
        number: the number to compare with.
    """

    text: str
    task: str | None
    figure: str
    end: str | None
    sign: str
    number: float

    def shortfalls(self, comparison: Comparison) -> Iterator[str]:
        """Yield a message for each figure that does not meet the requirement.

        Raises:
            UnknownName: the comparison does not include the task.
        """
        figures_of = {each.task: each.figures for each in comparison.tasks}
        if self.task is not None:
            if self.task not in figures_of:
                raise UnknownName(
                    "task in this comparison", self.task, list(figures_of)
                )
            figures_of = {self.task: figures_of[self.task]}
        elif self.figure in OVERALL_FIGURES:
            figures_of = {"all tasks": comparison.figures}
        for whose, figures in figures_of.items():
            value = self._value(figures.get(self.figure))
            what = " ".join(filter(None, [self.figure, self.end]))
            if value is None:
                needs_scores = self.figure.startswith("IQM") and not comparison.scored
                why = _NO_SCORES if needs_scores else ""
                yield f"{self.text}: the {what} of {whose} is unknown{why}"
            elif not _SIGNS[self.sign](value, self.number):
                yield f"{self.text}: the {what} of {whose} is {value:.4g}"

    def _value(self, figure: Estimate | None) -> float | None:
        if figure is None or self.end is None:
            return None if figure is None else figure.value
        ends = figure.interval
        return None if ends is None else getattr(ends, self.end)


def parse_requirement(text: str) -> Requirement:
    """Parse a requirement: `[TASK: ]FIGURE [low|high] SIGN NUMBER`.

    Raises:
        InvalidArgument: the string does not have this form.
        UnknownName: there is no figure with this name.
    """
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise InvalidArgument(
            f"{text!r} is not a valid requirement. Write FIGURE > NUMBER (or >=, <, "
            "<=), such as 'probability of improvement > 0.75'."
        )
    task, figure = match["task"], match["figure"]
    figures = TASK_FIGURES if task else {*TASK_FIGURES, *OVERALL_FIGURES}
    if figure not in figures:
        raise UnknownName("comparison figure", figure, figures)
    number = float(match["number"])
    return Requirement(text, task, figure, match["end"], match["sign"], number)

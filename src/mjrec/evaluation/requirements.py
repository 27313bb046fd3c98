# SPDX-License-Identifier: Apache-2.0
"""What a comparison must show, such as `probability of improvement > 0.75`."""

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
_FORM: Final = re.compile(
    r"(?:(?P<task>.+):\s+)?(?P<figure>[^<>=:]+?)(?:\s+(?P<end>low|high))?"
    r"\s*(?P<sign>[<>]=?)\s*(?P<number>[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?)"
)


@dataclass(frozen=True)
class Requirement:
    """What a figure of a comparison must be.

    Attributes:
        text: as it was given.
        task: of which task; None is all together or, of a figure that only tasks have,
            each of them.
        figure: its name.
        end: `"low"` or `"high"`, that end of its interval; None is the figure itself.
        sign: how it is compared.
        number: with what.
    """

    text: str
    task: str | None
    figure: str
    end: str | None
    sign: str
    number: float

    def shortfalls(self, comparison: Comparison) -> Iterator[str]:
        """Yield why a comparison falls short of this; nothing where it does not.

        Raises:
            UnknownName: the task is not compared.
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
                yield f"{self.text}: the {what} of {whose} is not known"
            elif not _SIGNS[self.sign](value, self.number):
                yield f"{self.text}: the {what} of {whose} is {value:.4g}"

    def _value(self, figure: Estimate | None) -> float | None:
        if figure is None:
            return None
        if self.end is None:
            return figure.value
        interval = figure.interval
        if interval is None:
            return None
        return interval.low if self.end == "low" else interval.high


def parse_requirement(text: str) -> Requirement:
    """Return what a text requires: `[TASK: ]FIGURE [low|high] SIGN NUMBER`.

    Raises:
        InvalidArgument: it has another form.
        UnknownName: there is no such figure.
    """
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise InvalidArgument(
            "What is required is FIGURE > NUMBER (or >=, <, <=), such as 'probability "
            f"of improvement > 0.75', got {text!r}."
        )
    task, figure = match["task"], match["figure"]
    figures = TASK_FIGURES if task else {*TASK_FIGURES, *OVERALL_FIGURES}
    if figure not in figures:
        raise UnknownName("figure of a comparison", figure, figures)
    number = float(match["number"])
    return Requirement(text, task, figure, match["end"], match["sign"], number)

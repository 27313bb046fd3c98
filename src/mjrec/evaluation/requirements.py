# SPDX-License-Identifier: Apache-2.0
"""What a comparison must show, such as `probability of improvement > 0.75`."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from ..errors import InvalidArgument, UnknownName
from .comparing import Comparison

# By name: where the figure of a task stands, and that of all of them together. The
# interval of a figure stands beside it.
_OF_TASKS: Final = {
    "mean A": "mean_a",
    "mean B": "mean_b",
    "difference": "difference",
    "paired difference": "paired.difference",
    "probability of improvement": "probability",
    "p-value": "p_value_holm",
}
_OF_ALL: Final = {
    "probability of improvement": "probability",
    "IQM A": "scores.iqm_a",
    "IQM B": "scores.iqm_b",
    "IQM difference": "scores.difference",
}
_INTERVALS: Final = {
    "difference": "difference_interval",
    "paired difference": "paired.interval",
    "probability of improvement": "probability_interval",
    "IQM difference": "scores.interval",
}
_SIGNS: Final[dict[str, Callable[[float, float], bool]]] = {
    ">": operator.gt,
    ">=": operator.ge,
    "<": operator.lt,
    "<=": operator.le,
}
_FORM: Final = re.compile(
    r"(?:(?P<task>.+):\s+)?(?P<figure>[^<>=:]+?)(?:\s+(?P<end>low|high))?"
    r"\s*(?P<sign>[<>]=?)\s*(?P<number>[+-]?[0-9.]+(?:e[+-]?[0-9]+)?)"
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
        tasks = {each.task: each for each in comparison.tasks}
        if self.task is not None and self.task not in tasks:
            raise UnknownName("task in this comparison", self.task, list(tasks))
        if self.task is None and self.figure in _OF_ALL:
            yield from self._shortfall("", comparison, _OF_ALL[self.figure])
        else:
            for name in tasks if self.task is None else [self.task]:
                place = _OF_TASKS[self.figure]
                yield from self._shortfall(f" of {name}", tasks[name], place)

    def _shortfall(self, whose: str, said: object, place: str) -> Iterator[str]:
        value = _found(said, place)
        if self.end is not None:
            interval = _found(said, _INTERVALS[self.figure])
            value = _found(interval, self.end)
        what = f"{self.figure}{f' {self.end}' if self.end else ''}{whose}"
        if value is None:
            yield f"{self.text}: the {what} is not known"
        elif not _SIGNS[self.sign](value, self.number):
            yield f"{self.text}: the {what} is {value:.4g}"


def parse_requirement(text: str) -> Requirement:
    """Return what a text requires: `[TASK: ]FIGURE [low|high] SIGN NUMBER`.

    Raises:
        InvalidArgument: it has another form, or that figure has no interval.
        UnknownName: there is no such figure.
    """
    match = _FORM.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError
        number = float(match["number"])
    except ValueError:
        raise InvalidArgument(
            "What is required is FIGURE > NUMBER (or >=, <, <=), such as 'probability "
            f"of improvement > 0.75', got {text!r}."
        ) from None
    task, figure, end = match["task"], match["figure"], match["end"]
    figures = _OF_TASKS if task else {**_OF_TASKS, **_OF_ALL}
    if figure not in figures:
        raise UnknownName("figure of a comparison", figure, list(figures))
    if end is not None and figure not in _INTERVALS:
        raise InvalidArgument(f"{figure!r} has no interval, in {text!r}.")
    return Requirement(text, task, figure, end, match["sign"], number)


def _found(said: Any, place: str) -> Any:
    """Return what stands there; None where there is nothing on the way."""
    for name in place.split("."):
        said = None if said is None else getattr(said, name)
    return said

# SPDX-License-Identifier: Apache-2.0
"""Which episodes of an evaluation get a video: `keep`.

Decided for each task by itself, when all of its episodes are done, so that it depends
on neither the workers nor the order in which they came. A rule is one of

==========  ==========================================================================
`cubic`     0, 1, 8, 27 ... and every 1000th, counted over the seeds in their order
`all`       every one
`none`      none
==========  ==========================================================================

or several of these, separated by commas:

==============  ======================================================================
`best[:N]`      the N of the highest return, one if no number is given
`worst[:N]`     the N of the lowest return
`median`        the one whose return is the median, of an even number the lower one
`failures[:N]`  the first N, or all, that were no success; where the environment says
                nothing of that, those that it terminated; and those that the policy
                or the environment could not complete
==============  ======================================================================

Of equal returns the earlier episode counts, in the order of seeds and numbers. A return
that is not a number is the worst. What could not be completed has no return, and is
neither best, median nor worst. An episode may be several of these: where all returns
are equal, the first is the best, the median and the worst.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from ..errors import InvalidArgument, UnknownName
from ..schedules import capped_cubic_video_schedule
from .episode_results import EpisodeResult

Chosen: TypeAlias = tuple[EpisodeResult, str]
_Part: TypeAlias = Callable[[Sequence[EpisodeResult]], list[Chosen]]

RULES = (
    *("best", "best:N", "median", "worst", "worst:N", "failures", "failures:N"),
    *("cubic", "all", "none"),
)

# What is logged, with the reason, where none of them can be drawn.
NO_GL = (
    "No video can be drawn here, and those that are chosen will stay pending "
    "(--keep none wants none): %s"
)

_ALONE = ("cubic", "all", "none")
_COUNTED = re.compile(r"(?P<kind>best|worst|failures)(:(?P<count>[1-9][0-9]{0,17}))?")


@dataclass(frozen=True)
class KeepRule:
    """A rule.

    Attributes:
        name: as a person wrote it.
        parts: chooses by each part of it.
    """

    name: str
    parts: tuple[_Part, ...]

    @property
    def keeps_none(self) -> bool:
        """Whether no episode gets a video."""
        return not self.parts

    def choose(self, results: Sequence[EpisodeResult]) -> list[Chosen]:
        """Return the chosen episodes, each with its role, in the order of the rule.

        Args:
            results: all those of a task, by seeds in the plan's order, then by number.
        """
        return [chosen for part in self.parts for chosen in part(results)]


def keep_rule(text: str) -> KeepRule:
    """Return the rule that `text` names, see the module.

    Raises:
        UnknownName: there is no such rule.
        InvalidArgument: it is no text, a part of it is there twice, or one that stands
            alone is not alone.
    """
    if not isinstance(text, str):
        raise InvalidArgument(
            f"keep must be a text such as 'best,median,worst', got {text!r}."
        )
    names = [name.strip() for name in text.split(",")]
    parts = tuple(part for name in names for part in _parts(name))
    kinds = [name.partition(":")[0] for name in names]
    if len(kinds) > 1 and set(kinds) & set(_ALONE):
        raise InvalidArgument(
            f"keep={text!r}: {', '.join(_ALONE)} stand alone; only best, median, worst "
            "and failures go together."
        )
    if len(set(kinds)) < len(kinds):
        raise InvalidArgument(f"keep={text!r} names something twice.")
    return KeepRule(",".join(names), parts)


def _parts(name: str) -> list[_Part]:
    match name:
        case "none":
            return []
        case "all":
            return [_all]
        case "cubic":
            return [_cubic]
        case "median":
            return [_median]
    counted = _COUNTED.fullmatch(name)
    if counted is None:
        raise UnknownName("keep rule", name, RULES, hint="N is a whole number from 1.")
    number = None if counted["count"] is None else int(counted["count"])
    match counted["kind"]:
        case "best":
            return [lambda results: _first(number or 1, results, _better, "best")]
        case "worst":
            return [lambda results: _first(number or 1, results, _worse, "worst")]
    return [lambda results: _failures(results)[:number]]


_Key: TypeAlias = tuple[bool, float]


def _worse(result: EpisodeResult) -> _Key:
    """Return what sorts the worst episode first; sorting keeps the order of equals."""
    value = math.nan if result.total_reward is None else result.total_reward
    return (False, 0.0) if math.isnan(value) else (True, value)


def _better(result: EpisodeResult) -> _Key:
    is_number, value = _worse(result)
    return not is_number, -value


def _first(
    count: int,
    results: Sequence[EpisodeResult],
    order: Callable[[EpisodeResult], _Key],
    role: str,
) -> list[Chosen]:
    completed = [each for each in results if each.failure is None]
    return [(each, role) for each in sorted(completed, key=order)[:count]]


def _median(results: Sequence[EpisodeResult]) -> list[Chosen]:
    completed = [each for each in results if each.failure is None]
    if not completed:
        return []
    ordered = sorted(completed, key=_worse)
    middle = _worse(ordered[(len(ordered) - 1) // 2])
    # Sorting has kept the order of those with equal returns.
    return [(next(each for each in ordered if _worse(each) == middle), "median")]


def _failures(results: Sequence[EpisodeResult]) -> list[Chosen]:
    return [
        (each, "failure") for each in results if _is_failure(each) and _is_shown(each)
    ]


def _is_failure(result: EpisodeResult) -> bool:
    if result.failure is not None:
        return True
    return bool(result.terminated) if result.success is None else not result.success


def _all(results: Sequence[EpisodeResult]) -> list[Chosen]:
    return [(each, "all") for each in results if _is_shown(each)]


def _cubic(results: Sequence[EpisodeResult]) -> list[Chosen]:
    return [
        (each, "cubic")
        for number, each in enumerate(results)
        if capped_cubic_video_schedule(number) and _is_shown(each)
    ]


def _is_shown(result: EpisodeResult) -> bool:
    """Return whether there is something of an episode to be seen."""
    return result.monitor is not None and result.length > 0

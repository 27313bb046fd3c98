# SPDX-License-Identifier: Apache-2.0
"""Which episodes get a video, by how they ended: `keep`.

A rule is one or several of these, separated by commas:

==============  ======================================================================
`best[:N]`      the N of the highest return, one if no number is given
`worst[:N]`     the N of the lowest return
`median`        the one whose return is the median, of an even number the lower one
`failures[:N]`  the first N, or all, that were no success; where the environment does
                not say, those that it terminated; and those that could not be completed
==============  ======================================================================

or, of an evaluation only, one of these:

==========  ==========================================================================
`cubic`     0, 1, 8, 27 ... and every 1000th, counted over all seeds
`all`       every one
`none`      none
==========  ==========================================================================

Of equal returns the earlier episode counts. A return that is not a number is the worst.
What could not be completed has no return, and is neither best, median nor worst. An
episode may be several of these: where all returns are equal, the first is the best, the
median and the worst.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from ..errors import InvalidArgument, UnknownName
from ..schedules import capped_cubic_video_schedule

RULES = ("best", "best:N", "worst", "worst:N", "median", "failures", "failures:N")
RULES_OF_EVALUATIONS = (*RULES, "cubic", "all", "none")

_ALONE = ("cubic", "all", "none")
_COUNTED = re.compile(
    r"(?P<kind>best|worst|failures)(:(?P<count>[1-9]\d{0,17}))?", re.ASCII
)


class Ended(Protocol):
    """An episode that is over."""

    @property
    def reward(self) -> float | None:
        """The return; None where it could not be completed."""

    @property
    def terminated(self) -> bool | None:
        """Whether the task ended it."""

    @property
    def success(self) -> bool | None:
        """What the environment said of it; None where it said nothing."""


_E = TypeVar("_E", bound=Ended)


@dataclass(frozen=True)
class Part:
    """A part of a rule.

    Attributes:
        role: what it chooses: `"best"`, `"worst"`, `"median"`, `"failure"`, `"cubic"`
            or `"all"`.
        count: the most episodes; None where that is not limited.
    """

    role: str
    count: int | None = None

    def choose(self, episodes: Sequence[_E | None]) -> list[_E]:
        """Return the chosen episodes, in the order of the rule.

        Args:
            episodes: in their order; None stands for one that was never begun.
        """
        begun = [each for each in episodes if each is not None]
        match self.role:
            case "best":
                chosen = sorted(_completed(begun), key=_rank, reverse=True)
            case "worst":
                chosen = sorted(_completed(begun), key=_rank)
            case "median":
                chosen = _median(_completed(begun))
            case "failure":
                chosen = [each for each in begun if has_failed(each)]
            case "cubic":
                numbered = enumerate(episodes)
                is_chosen = capped_cubic_video_schedule
                chosen = [e for k, e in numbered if e is not None and is_chosen(k)]
            case _:
                chosen = begun
        return chosen[: self.count]


@dataclass(frozen=True)
class KeepRule:
    """A rule.

    Attributes:
        name: as the manifest has it.
        parts: of it.
    """

    name: str
    parts: tuple[Part, ...]

    @property
    def keeps_none(self) -> bool:
        """Whether no episode gets a video."""
        return not self.parts

    def choose(self, episodes: Sequence[_E | None]) -> list[tuple[_E, str]]:
        """Return the chosen episodes with their roles, in the order of the rule."""
        return [(e, part.role) for part in self.parts for e in part.choose(episodes)]


def keep_rule(text: str, rules: Sequence[str] = RULES_OF_EVALUATIONS) -> KeepRule:
    """Return the rule that `text` names.

    Args:
        text: see the module.
        rules: those that there are, for messages; without them, `cubic`, `all` and
            `none` are none.

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
    for name in names:
        if name not in rules and not _COUNTED.fullmatch(name):
            raise UnknownName("keep rule", name, rules, hint="N is 1 or more.")
    kinds = [name.partition(":")[0] for name in names]
    if len(kinds) > 1 and set(kinds) & set(_ALONE):
        raise InvalidArgument(
            f"keep={text!r}: {', '.join(_ALONE)} stand alone; only best, median, worst "
            "and failures go together."
        )
    if len(set(kinds)) < len(kinds):
        raise InvalidArgument(f"keep={text!r} names something twice.")
    parts = () if names == ["none"] else tuple(map(_part, names))
    return KeepRule(",".join(names), parts)


def has_failed(episode: Ended) -> bool:
    """Return whether an episode is a failure.

    By what the environment says; by its termination where it says nothing, which is
    right for tasks that end when the robot falls.
    """
    if episode.reward is None:
        return True
    return bool(episode.terminated) if episode.success is None else not episode.success


def _part(name: str) -> Part:
    counted = _COUNTED.fullmatch(name)
    if counted is None:
        return Part(name, 1 if name == "median" else None)
    count = None if counted["count"] is None else int(counted["count"])
    if counted["kind"] == "failures":
        return Part("failure", count)
    return Part(counted["kind"], count or 1)


def _completed(episodes: Sequence[_E]) -> list[_E]:
    return [each for each in episodes if each.reward is not None]


def _rank(episode: Ended) -> tuple[bool, float]:
    reward = episode.reward
    # No number is below minus infinity.
    return (False, 0.0) if reward is None or math.isnan(reward) else (True, reward)


def _median(episodes: Sequence[_E]) -> list[_E]:
    # Sorting keeps the order of equal ones, in reverse too.
    ordered = sorted(map(_rank, episodes))
    middle = ordered[(len(ordered) - 1) // 2 :][:1]
    return [each for each in episodes if _rank(each) in middle][:1]

# SPDX-License-Identifier: Apache-2.0
"""Rules for `keep`, which chooses the episodes that get a video by their results.

A rule is one or more of these, separated by commas:

==============  ======================================================================
`best[:N]`      the N episodes with the highest return; N defaults to 1
`worst[:N]`     the N episodes with the lowest return; N defaults to 1
`median`        the episode with the median return; the lower one for an even number
`failures[:N]`  the first N failures, or all: episodes without success, or, if the
                environment does not report success, those that it terminated; and
                those that could not be completed
==============  ======================================================================

In an evaluation it may instead be one of these:

==========  ==========================================================================
`cubic`     0, 1, 8, 27 ... and every 1000th, counted over all seeds
`all`       every episode
`none`      no episode
==========  ==========================================================================

Ties go to the earlier episode. A NaN return ranks worst. An episode that could not be
completed has no return and is never best, median or worst. One episode can fill several
roles: if all returns are equal, the first is the best, the median and the worst.
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
    """A finished episode."""

    @property
    def reward(self) -> float | None:
        """The return; None if the episode could not be completed."""

    @property
    def terminated(self) -> bool | None:
        """Whether the task ended the episode."""

    @property
    def success(self) -> bool | None:
        """Whether it was a success; None if the environment does not report that."""


_E = TypeVar("_E", bound=Ended)


@dataclass(frozen=True)
class Part:
    """A part of a rule.

    Attributes:
        role: the role that it assigns: `"best"`, `"worst"`, `"median"`, `"failure"`,
            `"cubic"` or `"all"`.
        count: maximum number of episodes; None for no limit.
    """

    role: str
    count: int | None = None

    def choose(self, episodes: Sequence[_E | None]) -> list[_E]:
        """Return the chosen episodes, in the rule's order.

        Args:
            episodes: all episodes, in order; None for one that never began.
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
    """A parsed `keep` rule.

    Attributes:
        name: the rule's name in the manifest.
        parts: the rule's parts.
    """

    name: str
    parts: tuple[Part, ...]

    @property
    def keeps_none(self) -> bool:
        """Whether no episode gets a video."""
        return not self.parts

    def choose(self, episodes: Sequence[_E | None]) -> list[tuple[_E, str]]:
        """Return the chosen episodes with their roles, in the rule's order."""
        return [(e, part.role) for part in self.parts for e in part.choose(episodes)]


def keep_rule(text: str, rules: Sequence[str] = RULES_OF_EVALUATIONS) -> KeepRule:
    """Parse a `keep` rule.

    Args:
        text: the rule; see the module docstring.
        rules: the valid names, listed in messages. `cubic`, `all` and `none` are
            accepted only if listed here.

    Raises:
        UnknownName: the rule does not exist.
        InvalidArgument: `text` is not a string, a part is given twice, or `cubic`,
            `all` or `none` is combined with another part.
    """
    if not isinstance(text, str):
        raise InvalidArgument(
            f"keep must be a string such as 'best,median,worst', got {text!r}."
        )
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in rules and not _COUNTED.fullmatch(name):
            raise UnknownName("keep rule", name, rules, hint="N is 1 or more.")
    kinds = [name.partition(":")[0] for name in names]
    if len(kinds) > 1 and set(kinds) & set(_ALONE):
        raise InvalidArgument(
            f"keep={text!r} is invalid: {', '.join(_ALONE)} must be used alone; only "
            "best, median, worst and failures can be combined."
        )
    if len(set(kinds)) < len(kinds):
        raise InvalidArgument(f"keep={text!r} names the same rule twice.")
    parts = () if names == ["none"] else tuple(map(_part, names))
    return KeepRule(",".join(names), parts)


def has_failed(episode: Ended) -> bool:
    """Return whether an episode is a failure.

    This is the success that the environment reports. Without a report, a terminated
    episode is a failure, which is right for tasks that end when the robot falls.
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
    # NaN must rank below minus infinity, hence the bool.
    return (False, 0.0) if reward is None or math.isnan(reward) else (True, reward)


def _median(episodes: Sequence[_E]) -> list[_E]:
    # Sorting is stable, even in reverse.
    ordered = sorted(map(_rank, episodes))
    middle = ordered[(len(ordered) - 1) // 2 :][:1]
    return [each for each in episodes if _rank(each) in middle][:1]

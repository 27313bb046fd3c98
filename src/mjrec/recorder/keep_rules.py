# SPDX-License-Identifier: Apache-2.0
"""Rules for `keep`, which chooses episodes for videos based on their results.

A rule is one or more of these, separated by commas:

==============  ======================================================================
`best[:N]`      the N episodes with the highest return; N defaults to 1
`worst[:N]`     the N episodes with the lowest return; N defaults to 1
`median`        the episode with the median return; if the number of episodes is even,
                the lower of the two middle returns is used
`failures[:N]`  the first N failures, or all failures if N is not given
==============  ======================================================================

An episode is a failure if it was unsuccessful or could not be completed. If the
environment does not report success, an episode is a failure if the task terminated it.

In an evaluation, the rule may instead be one of these:

==========  ==========================================================================
`cubic`     episodes 0, 1, 8, 27 ... and every 1000th, counted over all seeds
`all`       every episode
`none`      no episode
==========  ==========================================================================

If returns are equal, the earlier episode is chosen. A NaN return ranks lowest. An
episode that could not be completed has no return and is never the best, the median or
the worst. An episode can have several roles. For example, if all returns are equal, the
first episode is the best, the median and the worst.
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
        """Whether the episode was a success; None if the environment does not say."""


_E = TypeVar("_E", bound=Ended)


@dataclass(frozen=True)
class Part:
    """A part of a rule.

    Attributes:
        role: the role of the chosen episodes: `"best"`, `"worst"`, `"median"`,
            `"failure"`, `"cubic"` or `"all"`.
        count: maximum number of episodes; None for no limit.
    """

    role: str
    count: int | None = None

    def choose(self, episodes: Sequence[_E | None]) -> list[_E]:
        """Return the chosen episodes, in the rule's order.

        Args:
            episodes: all episodes, in order; None for an episode that never began.
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
        text: the rule, as described in the module docstring.
        rules: the valid names, which are also listed in messages. `cubic`, `all` and
            `none` are accepted only if they are in this list.

    Raises:
        UnknownName: the rule does not exist.
        InvalidArgument: `text` is not a string, a part is repeated, or `cubic`, `all`
            or `none` is combined with another part.
    """
    if not isinstance(text, str):
        raise InvalidArgument(
            f"keep must be a string such as 'best,median,worst', but it is {text!r}."
        )
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in rules and not _COUNTED.fullmatch(name):
            raise UnknownName("keep rule", name, rules, hint="N must be 1 or more.")
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

    An episode is a failure if it could not be completed or if the environment reports
    no success. If the environment does not report success at all, a terminated episode
    is a failure, which is right for tasks that end when the robot falls.
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
    # The bool makes NaN rank below minus infinity.
    return (False, 0.0) if reward is None or math.isnan(reward) else (True, reward)


def _median(episodes: Sequence[_E]) -> list[_E]:
    # The sort is stable, even in reverse order.
    ordered = sorted(map(_rank, episodes))
    middle = ordered[(len(ordered) - 1) // 2 :][:1]
    return [each for each in episodes if _rank(each) in middle][:1]

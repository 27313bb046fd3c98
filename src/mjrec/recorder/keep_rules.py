# SPDX-License-Identifier: Apache-2.0
"""Rules for `keep`, which chooses episodes for videos based on their results.

A rule consists of one or more of the following, separated by commas:

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

import enum
import functools
import logging
import math
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from ..errors import InvalidArgument, UnknownName
from ..plain_text import listed
from ..schedules import capped_cubic_video_schedule, check_takes_one, schedule_name
from .tracking import FinishedEpisode

# Maximum number of episode numbers listed in a message.
_SHOWN = 10
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
        """Whether the episode was successful; None if that is not reported."""


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
    that it was unsuccessful. If the environment does not report success, a terminated
    episode is a failure, which suits tasks that end when the robot falls.
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


logger = logging.getLogger(__name__)


class Standing(enum.Enum):
    """The state of an episode in a selection.

    Attributes:
        CHOSEN: the episode gets a video. This is final.
        CANDIDATE: the decision depends on later episodes or on the end of the run.
        DROPPED: the episode gets no video. This is final.
    """

    CHOSEN = "chosen"
    CANDIDATE = "candidate"
    DROPPED = "dropped"


@dataclass(eq=False)
class Selection:
    """Chooses among the finished episodes of a run.

    A selection is also a schedule, which includes every episode that might be chosen
    when it ends.

    Attributes:
        name: the rule's name in the manifest.
        choose: a function that takes episodes and returns the numbers of the chosen
            ones; None if only failures are chosen.
        holds_all: whether `choose` is called only once, at the end. Otherwise it is
            called after each episode, and an episode that it has rejected must remain
            rejected when more episodes are added.
        most_failures: maximum number of failures to choose in addition, as soon as they
            end; None for no limit.
        finished: number of episodes that have been added.
    """

    name: str
    choose: Callable[[Sequence[FinishedEpisode]], Iterable[int]] | None
    holds_all: bool
    most_failures: int | None = 0
    finished: int = 0
    _failures: int = 0
    _last_id: int = -1
    _is_closed: bool = False
    _candidates: dict[int, FinishedEpisode] = field(default_factory=dict)
    _chosen: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        # The manifest lists schedules by this name.
        self.__qualname__ = f"keep:{self.name}"

    def __call__(self, episode_id: int) -> bool:
        """Return whether to record an episode as if it were to get a video."""
        return self.choose is not None or self._has_room

    def add(self, episode: FinishedEpisode) -> None:
        """Add a finished episode.

        Episodes must be added in ascending order. An episode that was added before is
        ignored. A candidate that has been dropped is never considered again.
        """
        number = episode.episode_id
        if number <= self._last_id:
            return
        if self.holds_all and not self.finished:
            logger.info(
                "keep=%s chooses the episodes for videos at the end of the run. "
                "Until then, the recordings of all episodes are kept on disk.",
                self.name,
            )
        self.finished += 1
        self._last_id = number
        if self._has_room and has_failed(episode):
            self._chosen.add(number)
            self._failures += 1
        if self.choose is None:
            return
        self._candidates[number] = episode
        if not self.holds_all:
            best = set(self.choose([*self._candidates.values()]))
            self._candidates = {n: e for n, e in self._candidates.items() if n in best}

    def standing(self, episode_id: int) -> Standing:
        """Return the standing of an episode that has been added."""
        if episode_id in self._chosen:
            return Standing.CHOSEN
        is_candidate = episode_id in self._candidates
        return Standing.CANDIDATE if is_candidate else Standing.DROPPED

    @property
    def undecided(self) -> int:
        """Number of candidates for which no decision has been made."""
        return len(self._candidates.keys() - self._chosen)

    @property
    def chosen(self) -> list[int]:
        """Numbers of the chosen episodes, in ascending order."""
        return sorted(self._chosen)

    def close(self) -> None:
        """Decide on all candidates at the end of the run. Idempotent.

        Raises:
            InvalidArgument: the user's function raised an exception or did not return
                numbers of finished episodes. In that case, no decision is made.
        """
        if self.choose is not None and not self._is_closed:
            self._chosen.update(self.choose([*self._candidates.values()]))
        self._is_closed = True
        self._candidates.clear()

    @property
    def _has_room(self) -> bool:
        most = self.most_failures
        return most is None or self._failures < most


def selection_from(keep: object) -> Selection:
    """Return a new selection for a `keep` argument.

    Args:
        keep: a rule (see `keep_rules`), or a function that takes the finished episodes
            and returns the numbers of the chosen episodes.

    Raises:
        UnknownName: the rule does not exist.
        InvalidArgument: `keep` is neither a string nor a function, or it names a part
            twice.
    """
    if callable(keep):
        check_takes_one(keep, "keep", "the sequence of finished episodes")
        name = schedule_name(keep)
        return Selection(name, functools.partial(_ask, keep, name), holds_all=True)
    if not isinstance(keep, str):
        raise InvalidArgument(
            f"keep must be one of {', '.join(RULES)}, or a function that takes the "
            "finished episodes and returns the numbers of those to keep, but it is "
            f"{keep!r}."
        )
    rule = keep_rule(keep, RULES)
    ranked = [part for part in rule.parts if part.role != "failure"]
    failures = [part.count for part in rule.parts if part.role == "failure"]

    def choose(episodes: Sequence[FinishedEpisode]) -> set[int]:
        return {each.episode_id for part in ranked for each in part.choose(episodes)}

    return Selection(
        rule.name,
        choose if ranked else None,
        holds_all=any(part.role == "median" for part in ranked),
        most_failures=failures[0] if failures else 0,
    )


def _ask(
    function: Callable[[Sequence[FinishedEpisode]], Iterable[int]],
    name: str,
    episodes: Sequence[FinishedEpisode],
) -> frozenset[int]:
    """Call a user's function and check the numbers that it returns."""
    try:
        numbers = frozenset(map(_number, function(tuple(episodes))))
    except Exception as error:
        raise InvalidArgument(
            f"keep={name} could not choose among {len(episodes)} finished episodes: "
            f"{type(error).__name__}: {error}. It must return the numbers (episode_id) "
            "of the episodes to keep."
        ) from error
    known = [each.episode_id for each in episodes]
    unknown = sorted(numbers.difference(known))
    if unknown:
        raise InvalidArgument(
            f"keep={name} returned {listed(unknown, _SHOWN)}, but no finished episode "
            "has that number. The finished episodes are "
            f"{listed(known, _SHOWN) or 'none'}."
        )
    return numbers


def _number(value: Any) -> int:
    if isinstance(value, bool):
        # Most likely the function returned flags, which would mean episodes 0 and 1.
        raise TypeError(f"{value} is not an episode number")
    return operator.index(value)

# SPDX-License-Identifier: Apache-2.0
"""Choosing episodes as they end: `Monitor(..., keep=...)`.

A selection gets every finished episode, one after the other, and says of each how it
stands. It knows nothing of files.
"""

from __future__ import annotations

import enum
import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ..errors import InvalidArgument
from ..schedules import check_takes_one, schedule_name
from .keep_rules import RULES, has_failed, keep_rule
from .tracking import FinishedEpisode


class Standing(enum.Enum):
    """How an episode stands.

    Attributes:
        CHOSEN: it gets its video, for good.
        CANDIDATE: later episodes, or the end of the run, decide.
        DROPPED: it gets none, for good.
    """

    CHOSEN = "chosen"
    CANDIDATE = "candidate"
    DROPPED = "dropped"


class Selection:
    """Chooses among the finished episodes of one run.

    It is a schedule too: of every episode that may be chosen when it has ended.

    Args:
        name: of the rule, as the manifest has it.
        choose: returns the numbers of the chosen among given episodes; None where only
            failures are chosen.
        holds_all: it is asked once, at the end. Else it is asked after each episode,
            and what it does not choose among some it does not choose among more.
        most_failures: how many failures are chosen besides, as they end; None is all.

    Attributes:
        name, holds_all: as given.
        finished: how many episodes it got.
    """

    def __init__(
        self,
        name: str,
        choose: Callable[[Sequence[FinishedEpisode]], Iterable[int]] | None,
        *,
        holds_all: bool,
        most_failures: int | None = 0,
    ) -> None:
        self.name, self.holds_all = name, holds_all
        # Under which a schedule is written into the manifest.
        self.__qualname__ = f"keep:{name}"
        self.finished = 0
        self._choose = choose
        self._most_failures = most_failures
        self._failures = 0
        self._last_id = -1
        self._is_closed = False
        self._candidates: dict[int, FinishedEpisode] = {}
        self._chosen: set[int] = set()

    def facts(self) -> dict[str, Any]:
        """Return what a run says of it."""
        return {"rule": self.name}

    def __call__(self, episode_id: int) -> bool:
        """Return whether an episode is to be recorded, as if it got a video."""
        return self._choose is not None or self._has_room

    def add(self, episode: FinishedEpisode) -> None:
        """Take note of an episode; their numbers rise. Of the same one it counts once.

        A candidate that has fallen out never comes back.
        """
        number = episode.episode_id
        if number <= self._last_id:
            return
        self.finished += 1
        self._last_id = number
        if self._has_room and has_failed(episode):
            self._chosen.add(number)
            self._failures += 1
        if self._choose is None:
            return
        self._candidates[number] = episode
        if not self.holds_all:
            best = set(self._choose([*self._candidates.values()]))
            self._candidates = {n: e for n, e in self._candidates.items() if n in best}

    def standing(self, episode_id: int) -> Standing:
        """Return how an episode stands that it got."""
        if episode_id in self._chosen:
            return Standing.CHOSEN
        is_candidate = episode_id in self._candidates
        return Standing.CANDIDATE if is_candidate else Standing.DROPPED

    @property
    def undecided(self) -> int:
        """How many episodes are candidates."""
        return len(self._candidates.keys() - self._chosen)

    @property
    def chosen(self) -> list[int]:
        """The numbers of those that are chosen, rising."""
        return sorted(self._chosen)

    def close(self) -> None:
        """Decide about all candidates: there are no more episodes. Idempotent.

        Raises:
            InvalidArgument: the user's function raised, or did not return numbers of
                finished episodes. Nothing is decided then.
        """
        if self._choose is not None and not self._is_closed:
            self._chosen.update(self._choose([*self._candidates.values()]))
        self._is_closed = True
        self._candidates.clear()

    @property
    def _has_room(self) -> bool:
        most = self._most_failures
        return most is None or self._failures < most


def selection_from(keep: object) -> Selection:
    """Return a new selection by the rule that `keep` names or is.

    Args:
        keep: a rule, see `keep_rules`, or a function from the finished episodes to the
            numbers of the chosen.

    Raises:
        UnknownName: there is no such rule.
        InvalidArgument: it is neither text nor a function, or names a part twice.
    """
    if callable(keep):
        check_takes_one(keep, "keep", "the sequence of finished episodes")
        name = schedule_name(keep)
        return Selection(name, functools.partial(_ask, keep, name), holds_all=True)
    if not isinstance(keep, str):
        raise InvalidArgument(
            f"keep must be one of {', '.join(RULES)}, or a function from the finished "
            f"episodes to the numbers of those to keep, got {keep!r}."
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
    """Return what a user's function chooses, checked."""
    try:
        numbers = frozenset(map(_number, function(tuple(episodes))))
    except Exception as error:
        raise InvalidArgument(
            f"keep={name} could not choose among {len(episodes)} finished episodes: "
            f"{type(error).__name__}: {error}. It must return the numbers (episode_id) "
            "of those to keep."
        ) from error
    known = [each.episode_id for each in episodes]
    unknown = sorted(numbers.difference(known))
    if unknown:
        raise InvalidArgument(
            f"keep={name} returned {_listed(unknown)}, and no finished episode has "
            f"that number: there are {_listed(known)}."
        )
    return numbers


def _number(value: Any) -> int:
    if isinstance(value, bool):
        # Most likely a list of yes and no, which would name the episodes 0 and 1.
        raise TypeError(f"{value} is no number of an episode")
    return operator.index(value)


def _listed(numbers: Sequence[int], most: int = 10) -> str:
    shown = ", ".join(map(str, numbers[:most])) or "none"
    more = len(numbers) - most
    return f"{shown} and {more} more" if more > 0 else shown

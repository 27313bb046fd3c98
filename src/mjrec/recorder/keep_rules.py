# SPDX-License-Identifier: Apache-2.0
"""Which episodes get a video, decided after they ended: `Monitor(..., keep=...)`.

A selection gets every finished episode, one after the other, and says of each
how it stands. It knows nothing of files.
"""

from __future__ import annotations

import enum
import math
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

from ..errors import InvalidArgument, UnknownName
from ..schedules import check_takes_one, schedule_name
from .tracking import FinishedEpisode

Keep: TypeAlias = str | Callable[[Sequence[FinishedEpisode]], Iterable[int]]


RULES = ("best:N", "worst:N", "failures", "failures:N", "median")

_RULE = re.compile(r"(?P<kind>[^:]*)(?P<colon>:(?P<count>.*))?", re.DOTALL)
_COUNT = re.compile(r"[+-]?\d{1,18}", re.ASCII)
_KINDS = ("best", "worst", "failures", "median")


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

    Attributes:
        name: as given.
        finished: how many episodes it got.
        holds_all: every episode is a candidate until `close`.
    """

    holds_all = False

    def __init__(self, name: str) -> None:
        self.name = name
        # Under which a schedule is written into the manifest.
        self.__qualname__ = f"keep:{name}"
        self.finished = 0
        self._last_id = -1
        self._candidates: dict[int, FinishedEpisode] = {}
        self._chosen: set[int] = set()

    def facts(self) -> dict[str, Any]:
        """Return what a run says of it."""
        return {"rule": self.name}

    def __call__(self, episode_id: int) -> bool:
        """Return whether an episode is to be recorded, as if it got a video."""
        return True

    def add(self, episode: FinishedEpisode) -> None:
        """Take note of an episode; their numbers rise. Of the same one it counts once.

        A candidate that has fallen out never comes back.
        """
        if episode.episode_id > self._last_id:
            self._take(episode)
            self.finished += 1
            self._last_id = episode.episode_id

    def standing(self, episode_id: int) -> Standing:
        """Return how an episode stands that it got."""
        if episode_id in self._chosen:
            return Standing.CHOSEN
        is_candidate = episode_id in self._candidates
        return Standing.CANDIDATE if is_candidate else Standing.DROPPED

    @property
    def undecided(self) -> int:
        """How many episodes are candidates."""
        return len(self._candidates)

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
        self._chosen.update(self._candidates)
        self._candidates.clear()

    def _take(self, episode: FinishedEpisode) -> None:
        self._candidates[episode.episode_id] = episode


def selection_from(keep: object) -> Selection:
    """Return a new selection by the rule that `keep` names or is.

    Args:
        keep: `"best:N"` or `"worst:N"` (by return; of equal ones the earlier; a return
            that is not a number is the worst), `"failures"` or the first
            `"failures:N"`, `"median"` (the lower one; of equal ones the earliest), or
            a function from the finished episodes to the numbers of the chosen.

    Raises:
        UnknownName: there is no such rule.
        InvalidArgument: it is neither text nor a function, or N is not 1 or more.
    """
    if callable(keep):
        check_takes_one(keep, "keep", "the sequence of finished episodes")
        return _ByFunction(schedule_name(keep), keep)
    if not isinstance(keep, str):
        raise InvalidArgument(
            f"keep must be one of {', '.join(RULES)}, or a function from the finished "
            f"episodes to the numbers of those to keep, got {keep!r}."
        )
    rule = _RULE.fullmatch(keep)
    kind = "" if rule is None else rule["kind"]
    if rule is None or kind not in _KINDS or (kind == "median" and rule["colon"]):
        raise UnknownName("keep rule", keep, RULES, hint="A function is one too.")
    if kind == "median":
        return _ByFunction(keep, _median)
    if kind == "failures":
        return _Failures(keep, None if not rule["colon"] else _count(keep, rule))
    return _Extremes(keep, _count(keep, rule), _better if kind == "best" else _worse)


def _count(keep: str, rule: re.Match[str]) -> int:
    text = rule["count"] or ""
    count = int(text) if _COUNT.fullmatch(text) else 0
    if count < 1:
        raise InvalidArgument(
            f"keep={keep!r} names no number of episodes: a whole number, 1 or more, "
            f'stands behind the colon, as in "{rule["kind"]}:3".'
        )
    return count


_Key: TypeAlias = tuple[bool, float, int]


def _worse(episode: FinishedEpisode) -> _Key:
    """Return what sorts the worst episode first, and of equal ones the earliest."""
    is_number = not math.isnan(episode.reward)
    return is_number, episode.reward if is_number else 0.0, episode.episode_id


def _better(episode: FinishedEpisode) -> _Key:
    is_number, reward, episode_id = _worse(episode)
    return not is_number, -reward, episode_id


class _Extremes(Selection):
    """The first N in an order, as far as it is known."""

    def __init__(
        self, name: str, count: int, order: Callable[[FinishedEpisode], _Key]
    ) -> None:
        super().__init__(name)
        self._count = count
        self._order = order

    def _take(self, episode: FinishedEpisode) -> None:
        super()._take(episode)
        if len(self._candidates) > self._count:
            del self._candidates[max(map(self._order, self._candidates.values()))[-1]]


class _Failures(Selection):
    """Those that failed, decided at once."""

    def __init__(self, name: str, most: int | None) -> None:
        super().__init__(name)
        self._most = most

    def __call__(self, episode_id: int) -> bool:
        return self._most is None or len(self._chosen) < self._most

    def _take(self, episode: FinishedEpisode) -> None:
        if _has_failed(episode) and self(episode.episode_id):
            self._chosen.add(episode.episode_id)


def _has_failed(episode: FinishedEpisode) -> bool:
    """Tell it by what the environment says; by its termination where it says nothing.

    That is right for tasks that end when the robot falls.
    """
    return episode.terminated if episode.success is None else not episode.success


class _ByFunction(Selection):
    """What a function of all episodes returns, at the end."""

    holds_all = True

    def __init__(
        self,
        name: str,
        function: Callable[[Sequence[FinishedEpisode]], Iterable[int]],
    ) -> None:
        super().__init__(name)
        self._function = function
        self._is_decided = False

    def close(self) -> None:
        if not self._is_decided:
            self._chosen.update(self._ask())
            self._is_decided = True
            self._candidates.clear()

    def _ask(self) -> frozenset[int]:
        try:
            answer = self._function(tuple(self._candidates.values()))
            numbers = frozenset(map(_number, answer))
        except Exception as error:
            raise InvalidArgument(
                f"keep={self.name} could not choose among {len(self._candidates)} "
                f"finished episodes: {type(error).__name__}: {error}. It must return "
                "the numbers (episode_id) of those to keep."
            ) from error
        unknown = sorted(numbers - self._candidates.keys())
        if unknown:
            raise InvalidArgument(
                f"keep={self.name} returned {_listed(unknown)}, and no finished "
                f"episode has that number: there are {_listed([*self._candidates])}."
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


def _median(episodes: Sequence[FinishedEpisode]) -> list[int]:
    """Return the number of the episode whose return is the lower median."""
    if not episodes:
        return []
    ordered = sorted(map(_worse, episodes))
    middle = ordered[(len(ordered) - 1) // 2]
    return [next(number for *reward, number in ordered if reward == [*middle[:2]])]

# SPDX-License-Identifier: Apache-2.0
"""The choice of episodes for `Monitor(..., keep=...)`, made as the episodes end.

A selection receives each finished episode and decides which episodes are chosen, which
are dropped, and which are still candidates. It does not deal with files.
"""

from __future__ import annotations

import enum
import functools
import logging
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ..errors import InvalidArgument
from ..plain_text import listed
from ..schedules import check_takes_one, schedule_name
from .keep_rules import RULES, has_failed, keep_rule
from .tracking import FinishedEpisode

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


class Selection:
    """Chooses among the finished episodes of a run.

    A selection is also a schedule, which includes every episode that might be chosen
    when it ends.

    Args:
        name: the rule's name in the manifest.
        choose: function that takes episodes and returns the numbers of the chosen ones;
            None if only failures are chosen.
        holds_all: whether `choose` is called only once, at the end. Otherwise it is
            called after each episode, and an episode that it has rejected must remain
            rejected when more episodes are added.
        most_failures: maximum number of failures to choose in addition, as soon as they
            end; None for no limit.

    Attributes:
        name: the rule's name in the manifest.
        holds_all: whether the choice is made only at the end.
        finished: number of episodes that have been added.
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
        # The manifest lists schedules by this name.
        self.__qualname__ = f"keep:{name}"
        self.finished = 0
        self._choose = choose
        self._most_failures = most_failures
        self._failures = 0
        self._last_id = -1
        self._is_closed = False
        self._candidates: dict[int, FinishedEpisode] = {}
        self._chosen: set[int] = set()

    def __call__(self, episode_id: int) -> bool:
        """Return whether to record an episode as if it got a video."""
        return self._choose is not None or self._has_room

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
        if self._choose is None:
            return
        self._candidates[number] = episode
        if not self.holds_all:
            best = set(self._choose([*self._candidates.values()]))
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
        """Decide about all candidates at the end of the run. Idempotent.

        Raises:
            InvalidArgument: the user's function raised an exception or did not return
                numbers of finished episodes. In that case no decision is made.
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
            f"keep={name} returned {listed(unknown, 10)}, but no finished episode "
            f"has that number. The finished episodes are "
            f"{listed(known, 10) or 'none'}."
        )
    return numbers


def _number(value: Any) -> int:
    if isinstance(value, bool):
        # Most likely the function returned flags, which would mean episodes 0 and 1.
        raise TypeError(f"{value} is not an episode number")
    return operator.index(value)

# SPDX-License-Identifier: Apache-2.0
"""The recordings of a run whose videos are chosen after the episodes have ended.

Every episode is recorded as if it got a video. What is not decided yet is held: its
log calls it a candidate, which no other process touches while the monitor is open, and
any may render once the monitor is gone. What falls out is deleted at once.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

from ..errors import Error, InvalidArgument
from .recording import EpisodeRecording
from .selection import Selection, Standing
from .tracking import FinishedEpisode

logger = logging.getLogger(__name__)


class KeptVideos:
    """Holds, hands on or deletes recordings, as a selection has it.

    Args:
        selection: chooses.
    """

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        self._held: dict[int, EpisodeRecording] = {}
        self._is_decided = False
        # Why nothing could be decided, and which episodes stay for that.
        self._failure: str | None = None
        self._left: list[int] = []

    def chosen_facts(self) -> dict[str, Any]:
        """Return what is said of a video that is chosen, by which it is known."""
        selection = self.selection
        facts = {"rule": selection.name, "decided": True}
        return {**facts, "finished": selection.finished}

    def judge(self, episode_id: int, episode: FinishedEpisode | None) -> Standing:
        """Tell how an episode stands that has just ended.

        Args:
            episode_id: its number.
            episode: the episode; None where it was not completed.
        """
        if episode is not None:
            if self.selection.holds_all and not self.selection.finished:
                logger.info(
                    "Which episodes get a video is decided at the end (keep=%s): until "
                    "then the recordings of all of them stay on the disk.",
                    self.selection.name,
                )
            self.selection.add(episode)
        return self.selection.standing(episode_id)

    def hold(self, recording: EpisodeRecording) -> None:
        """Hold what there is of an episode that has ended, until it is decided on."""
        self._held[recording.episode_id] = recording

    def settle(self) -> None:
        """Hand on what is chosen by now, and delete what has fallen out.

        Raises:
            DirectoryNotWritable, FileNotWritten: as `EpisodeRecording.choose` and
                `drop`; one that fails is no other's fate.
        """
        if len(self._held) > self.selection.undecided:
            self._hand_on(list(self._held))

    def decide(self) -> None:
        """Decide about all that is held: there are no more episodes.

        Raises:
            InvalidArgument: the user's function could not choose. All episodes that
                are held stay, and their videos are pending, or there.
            DirectoryNotWritable, FileNotWritten: as of `settle`.
        """
        if self._is_decided or self._failure is not None:
            return
        try:
            self.selection.close()
        except InvalidArgument as error:
            self._failure = str(error)
            self._left = list(self._held)
            for recording in self._held.values():
                recording.expect()
            raise
        self._is_decided = True
        # What is wanted first: should this be killed, it has not lost that.
        chosen = set(self.selection.chosen)
        self._hand_on(sorted(self._held, key=lambda number: number not in chosen))

    def details(self) -> dict[str, Any]:
        """Return what the journal says of the choice, once it is made."""
        failure = {} if self._failure is None else {"failure": self._failure}
        return {
            "rule": self.selection.name,
            "decided": self._is_decided,
            "chosen": self.selection.chosen,
            "finished": self.selection.finished,
            "recorded": self._left or self.selection.chosen,
            **failure,
        }

    def _hand_on(self, episode_ids: Iterable[int]) -> None:
        failure: Error | None = None
        for episode_id in episode_ids:
            standing = self.selection.standing(episode_id)
            if standing is Standing.CANDIDATE:
                continue
            recording = self._held.pop(episode_id)
            try:
                if standing is Standing.CHOSEN:
                    recording.choose(self.chosen_facts())
                else:
                    recording.drop()
            except Error as error:
                failure = failure or error
        if failure is not None:
            raise failure

# SPDX-License-Identifier: Apache-2.0
"""The recordings of a run whose videos are chosen after their episodes have ended.

Every episode is recorded as if it got a video. The recordings for which no decision has
been made are held, and the log marks each of them as a candidate. While the monitor is
open, other processes leave candidates alone. After that, any process may render them.
Dropped recordings are deleted immediately.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ..errors import Error, InvalidArgument
from .recording import EpisodeRecording
from .selection import Selection, Standing


class KeptVideos:
    """Holds, submits or deletes recordings as a selection decides.

    Args:
        selection: the object that chooses the episodes that get a video.
    """

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        self._held: dict[int, EpisodeRecording] = {}
        self._is_decided = False
        # The reason why no decision could be made, and the episodes kept because of it.
        self._failure: str | None = None
        self._left: list[int] = []

    def chosen_facts(self) -> dict[str, Any]:
        """Return the facts that mark a video as chosen."""
        selection = self.selection
        facts = {"rule": selection.name, "decided": True}
        return {**facts, "finished": selection.finished}

    def hold(self, recording: EpisodeRecording) -> None:
        """Hold the recording of an ended episode until it is chosen or dropped."""
        self._held[recording.episode_id] = recording

    def settle(self) -> None:
        """Submit the recordings that are already chosen, and delete dropped ones.

        Raises:
            DirectoryNotWritable, FileNotWritten: see `EpisodeRecording.choose` and
                `drop`. A failure does not affect the other recordings.
        """
        if len(self._held) > self.selection.undecided:
            self._hand_on(list(self._held))

    def decide(self) -> None:
        """Decide about all held recordings at the end of the run.

        Raises:
            InvalidArgument: the user's function could not choose. All held episodes are
                kept, and their videos are pending or already exist.
            DirectoryNotWritable, FileNotWritten: see `settle`.
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
        # Chosen recordings come first, so that they survive if the process is killed.
        chosen = set(self.selection.chosen)
        self._hand_on(sorted(self._held, key=lambda number: number not in chosen))

    def details(self) -> dict[str, Any]:
        """Return the facts about the final choice for the journal."""
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

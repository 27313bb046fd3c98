# SPDX-License-Identifier: Apache-2.0
"""What the files of a dead monitor say of the episodes that it recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import KILLED, JournalEntry, JournalReader
from ..formats.monitor_directory import episode_of
from ..formats.trajectory_file import find_trajectory
from .killed_leftovers import Remains
from .recorded_facts import open_for_rendering


class KnownEpisodes:
    """The episodes of a monitor, as its journal and its trajectories have them.

    Only those with a trajectory or a video: of the others there may be millions.

    Args:
        remains: the monitor's files, as they were found.

    Attributes:
        infix: the monitor's.
        numbers: of the episodes.
        journaled: those that the journal has, complete or cut off.
    """

    def __init__(self, remains: Remains) -> None:
        self._directory = remains.directory
        self.infix = remains.infix
        self.numbers = {
            number
            for path in remains.known_paths
            if (number := episode_of(path.name)) is not None
        }
        self.journaled: set[int] = set()
        self._facts: dict[int, Mapping[str, Any]] = {}
        self._entries: dict[int, JournalEntry] = {}
        journal = remains.files.journal
        # One that cannot be read is reported when the statistics are made.
        with contextlib.suppress(UnreadableFile):
            if journal is not None:
                self._read(journal)

    def entry(self, number: int) -> JournalEntry | None:
        """Return the journal's line of an episode that is complete."""
        return self._entries.get(number)

    def facts(self, number: int | None) -> Mapping[str, Any]:
        """Return what an episode's trajectory says.

        Nothing where there is none, or a damaged one, which is reported elsewhere.
        """
        if number is None:
            return {}
        if number in self._facts:
            return self._facts[number]
        path = find_trajectory(self._directory, self.infix, number)
        facts: Mapping[str, Any] = {}
        if path is not None:
            with (
                contextlib.suppress(UnreadableFile),
                open_for_rendering(path) as reader,
            ):
                facts = reader.facts
        if path is None or path.is_file():
            # Of a log that gets its final form more is known afterwards.
            self._facts[number] = facts
        return facts

    def ending(self, number: int | None) -> dict[str, Any] | None:
        """Return how an episode ended; None where it was cut off."""
        facts = self.facts(number)
        if "complete" in facts and facts.get("reason") != KILLED:
            keys = ("complete", "terminated", "truncated", "reason", "exception")
            return {key: facts[key] for key in keys if key in facts}
        entry = None if number is None else self.entry(number)
        if entry is None:
            return None
        return {
            "complete": True,
            "terminated": entry.terminated,
            "truncated": entry.truncated,
        }

    def sums(self, number: int | None) -> dict[str, Any]:
        """Return length and reward of an episode, as far as they are known."""
        entry = None if number is None else self.entry(number)
        if entry is not None:
            return {"length": entry.length, "reward": entry.reward}
        facts = self.facts(number)
        return {key: facts[key] for key in ("length", "reward") if key in facts}

    def _read(self, journal: Path) -> None:
        for entry in JournalReader(journal, on_event=self._note):
            if entry.episode_id in self.numbers:
                self._entries[entry.episode_id] = entry
                self.journaled.add(entry.episode_id)

    def _note(self, kind: str, facts: Any) -> None:
        if kind == "cut" and isinstance(facts, Mapping):
            self.journaled.add(facts.get("episode_id", -1))

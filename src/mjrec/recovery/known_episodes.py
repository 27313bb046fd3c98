# SPDX-License-Identifier: Apache-2.0
"""What the files of a dead monitor say of its episodes."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import JournalEntry, JournalReader
from ..formats.monitor_directory import episode_of
from ..formats.trajectory_file import find_trajectory
from ..rendering.recorded_facts import open_for_rendering
from ..results.recorded_environment import recorded_env_info
from ..results.sources import MonitorResults
from .clips import last_clip_episode
from .remains import Remains


class KnownEpisodes:
    """The episodes of a monitor, as its journal and its trajectories have them.

    Args:
        remains: the monitor's files, as they were found.

    Attributes:
        infix: the monitor's.
        env_info: what was recorded; None where nothing says it.
        first_episode_id: the lowest number that any file speaks of; None where none.
        last_episode_id: the highest number that any file speaks of; -1 where none.
    """

    def __init__(self, remains: Remains) -> None:
        self._remains = remains
        self.infix = remains.infix
        files = remains.files
        # Of the running episodes and those with a video: of the others, of which
        # there may be millions, nothing is asked.
        self._recorded = {
            number
            for path in remains.known_paths
            if (number := episode_of(path.name)) is not None
        }
        self._facts: dict[int, Mapping[str, Any]] = {}
        self._entries: dict[int, JournalEntry] = {}
        self.first_episode_id = min(self._recorded, default=None)
        # Those of clips are in no name.
        self.last_episode_id = max(files.last_episode_id, last_clip_episode(remains))
        self._read_journal()
        # Asked now: of a log that is finished it could not be asked so cheaply.
        self.env_info = self._env_info()

    def entry(self, episode_id: int) -> JournalEntry | None:
        """Return the journal's line of an episode that was recorded."""
        return self._entries.get(episode_id)

    def facts(self, episode_id: int) -> Mapping[str, Any]:
        """Return what an episode's trajectory says; nothing where there is none.

        Raises:
            UnreadableFile: it is damaged.
        """
        if episode_id not in self._facts:
            path = find_trajectory(
                self._remains.directory, self._remains.infix, episode_id
            )
            facts: Mapping[str, Any] = {}
            if path is not None:
                with open_for_rendering(path) as reader:
                    facts = reader.header.facts
            self._facts[episode_id] = facts
        return self._facts[episode_id]

    def _read_journal(self) -> None:
        journal = self._remains.files.journal
        if journal is None:
            return
        reader = JournalReader(journal)
        first = self.first_episode_id
        # One that cannot be read is told of when the statistics are made of it.
        with contextlib.suppress(UnreadableFile):
            for entry in reader:
                number = entry.episode_id
                first = number if first is None else min(first, number)
                if number in self._recorded:
                    self._entries[number] = entry
        self.first_episode_id = first
        self.last_episode_id = max(self.last_episode_id, reader.last_episode_id)

    def _env_info(self) -> Mapping[str, Any] | None:
        files = self._remains.files
        try:
            manifest = MonitorResults(files).manifest
        except UnreadableFile:
            manifest = None
        return recorded_env_info(files, manifest)

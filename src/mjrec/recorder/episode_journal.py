# SPDX-License-Identifier: Apache-2.0
"""The journal of a run, told of finished episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from ..errors import FileNotWritten
from ..formats.journal import JournalEntry, JournalWriter
from .tracking import FinishedEpisode


class EpisodeJournal:
    """Adds a line to the journal for each finished episode.

    Args:
        path: of the journal.
        env_info: what is recorded, for its first line.
        tolerates: tells whether to go on without a line that cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        env_info: Mapping[str, str],
        tolerates: Callable[[FileNotWritten], bool],
    ) -> None:
        self._path = path
        self._writer = JournalWriter(path, env_info=env_info)
        self._tolerates = tolerates

    def add(self, episode: FinishedEpisode) -> None:
        """Write the line of an episode that has just ended.

        Raises:
            FileNotWritten: the disk is full.
        """
        entry = JournalEntry(
            episode_id=episode.episode_id,
            length=episode.length,
            reward=episode.reward,
            type=episode.type,
            start_time=episode.start_time,
            end_time=episode.end_time,
            seed=episode.seed,
            options=episode.options,
            terminated=episode.terminated,
            truncated=episode.truncated,
            success=episode.success,
        )
        try:
            self._writer.append(entry)
        except OSError as error:
            named = FileNotWritten(self._path, error.strerror or error)
            if not self._tolerates(named):
                raise named from error

    def close(self) -> None:
        """Let go of the file; idempotent."""
        self._writer.close()

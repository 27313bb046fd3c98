# SPDX-License-Identifier: Apache-2.0
"""Which of a monitor's files its statistics are taken from.

A monitor writes each episode twice: into its journal as the episode ends, and into its
statistics file, which belongs to the manifest, when it closes (or at each reset). A
killed monitor leaves a journal alone, or an older manifest beside it. The file with
more episodes wins, and never are episodes taken from both.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import JournalReader, count_lines
from ..formats.manifest import Manifest, read_manifest
from ..formats.stats_file import StatsFile, read_stats_file
from .monitor_files import MonitorFiles
from .recorded_environment import recorded_env_info

logger = logging.getLogger(__name__)


class MonitorResults:
    """What one monitor counted, as far as its files still tell.

    Where a manifest or a statistics file is damaged or missing, the journal stands in
    for it, and the other way round; the log then has a warning that names the file.

    Args:
        files: of the monitor.

    Attributes:
        files: as given.
    """

    def __init__(self, files: MonitorFiles) -> None:
        self.files = files
        self._said: set[Path] = set()

    @functools.cached_property
    def manifest(self) -> Manifest | None:
        """What the manifest says; None where there is none.

        Raises:
            UnreadableFile: it is damaged, and there is no journal either.
        """
        path = self.files.manifest
        if path is None:
            return None
        try:
            return read_manifest(path)
        except UnreadableFile as error:
            self._without(error)
            return None

    @functools.cached_property
    def saved(self) -> StatsFile | None:
        """What the statistics file holds; None where there is none.

        Raises:
            UnreadableFile: it is missing though a manifest names it, or damaged, and
                there is no journal either.
        """
        path = self._stats_path
        if path is None:
            return None
        try:
            return read_stats_file(path)
        except UnreadableFile as error:
            self._without(error)
            return None

    @property
    def details(self) -> Mapping[str, Any]:
        """What this package adds to a manifest; nothing where there is none."""
        manifest = self.manifest
        return {} if manifest is None or manifest.mjrec is None else manifest.mjrec

    @functools.cached_property
    def pending_ids(self) -> frozenset[int]:
        """The numbers of the episodes whose videos the manifest calls pending."""
        entries = self.details.get("pending")
        numbers = (
            entry.get("episode_id")
            for entry in (entries if isinstance(entries, list) else ())
            if isinstance(entry, dict)
        )
        return frozenset(number for number in numbers if type(number) is int)

    @property
    def env_info(self) -> Mapping[str, Any] | None:
        """What was recorded; None where nothing says it."""
        return recorded_env_info(self.files, self.manifest)

    def stats(self) -> StatsFile:
        """Return the statistics of the source with more episodes.

        Raises:
            UnreadableFile: no source can be read.
        """
        saved, journal = self.saved, self.files.journal
        if journal is not None and self.is_behind:
            return _stats_of(journal, saved)
        return StatsFile(None, (), (), (), ()) if saved is None else saved

    @functools.cached_property
    def journal_count(self) -> int:
        """How many episodes the journal has; -1 where there is none to read.

        Raises:
            UnreadableFile: it cannot be read, and there are no statistics either.
        """
        return self._of_journal(_count_episodes)

    @property
    def saved_count(self) -> int:
        """How many episodes the statistics file has; -1 where there is none to read."""
        return -1 if self.saved is None else len(self.saved.timestamps)

    @functools.cached_property
    def is_behind(self) -> bool:
        """Whether the journal has episodes that the statistics file lacks.

        Raises:
            UnreadableFile: as `journal_count`.
        """
        # A closed monitor's journal need not be understood for that.
        return (
            self._of_journal(count_lines) > self.saved_count
            and self.journal_count > self.saved_count
        )

    def _of_journal(self, count: Callable[[Path], int]) -> int:
        if self.files.journal is None:
            return -1
        try:
            return count(self.files.journal)
        except UnreadableFile as error:
            if self.saved is None:
                raise
            self._say(error, "statistics file")
            return -1

    @property
    def _stats_path(self) -> Path | None:
        if self.manifest is None:
            # A process that died between writing the two.
            return self.files.stats
        assert self.files.manifest is not None
        return self.files.manifest.with_name(self.manifest.stats)

    def _without(self, error: UnreadableFile) -> None:
        if self.files.journal is None:
            raise error
        self._say(error, "journal")

    def _say(self, error: UnreadableFile, instead: str) -> None:
        if error.path not in self._said:
            self._said.add(error.path)
            logger.warning("%s Its monitor's %s is used instead.", error, instead)


def _count_episodes(journal: Path) -> int:
    reader = JournalReader(journal)
    for _ in reader:
        pass
    return reader.count


def _stats_of(journal: Path, saved: StatsFile | None) -> StatsFile:
    """Return the statistics that a journal amounts to."""
    starts: list[float] = []
    ends: list[float] = []
    lengths: list[int] = []
    rewards: list[float] = []
    types: list[str] = []
    reader = JournalReader(journal)
    for entry in reader:
        starts.append(entry.start_time)
        ends.append(entry.end_time)
        lengths.append(entry.length)
        rewards.append(entry.reward)
        types.append(entry.type)
    reader.report()
    # The first reset may have been one whose episode never ended.
    start = None if saved is None else saved.initial_reset_timestamp
    if start is None:
        start = min((s for s in starts if not math.isnan(s)), default=None)
    return StatsFile(start, tuple(ends), tuple(lengths), tuple(rewards), tuple(types))

# SPDX-License-Identifier: Apache-2.0
"""A monitor's results, read from its journal or from its statistics file.

A monitor writes each episode twice: to its journal when the episode ends, and to its
statistics file when the monitor closes (or at each reset). A killed monitor leaves only
a journal, or a journal and an older manifest. The file with more episodes is used;
episodes are never taken from both.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from ..errors import UnreadableFile
from ..formats.journal import JournalEntry, read_journal
from ..formats.json_fields import json_object
from ..formats.manifest import Manifest, StatsFile, read_manifest, read_stats_file
from .monitor_files import MonitorFiles
from .run import Run

T = TypeVar("T")

logger = logging.getLogger(__name__)

# A lock contains one line. This limits how much of a forged file is read.
_LONGEST_LOCK = 1 << 16


class MonitorResults:
    """The results of one monitor, as far as its files can be read.

    The journal replaces a damaged or missing manifest or statistics file, and vice
    versa. A logged warning names the damaged file.

    Args:
        files: the monitor's files.

    Attributes:
        files: the monitor's files.
    """

    def __init__(self, files: MonitorFiles) -> None:
        self.files = files
        self._said: set[Path] = set()

    @functools.cached_property
    def manifest(self) -> Manifest | None:
        """The manifest, or None if it is missing or damaged.

        Raises:
            UnreadableFile: the manifest is damaged and the journal is missing.
        """
        return self._read(self.files.manifest, read_manifest)

    @functools.cached_property
    def saved(self) -> StatsFile | None:
        """The content of the statistics file, or None if it is missing or damaged.

        Raises:
            UnreadableFile: the file is damaged, or is missing although a manifest names
                it, and the journal is missing too.
        """
        path = self.files.stats
        if self.manifest is not None and self.files.manifest is not None:
            path = self.files.manifest.with_name(self.manifest.stats)
        return self._read(path, read_stats_file)

    @functools.cached_property
    def run(self) -> Run:
        """The run, from the journal or, if that lacks its start, from the manifest.

        Raises:
            UnreadableFile: the journal cannot be read, and there are no statistics.
        """
        run = Run()
        try:
            if self.files.journal is not None:
                run = Run.read(self.files.journal)
        except UnreadableFile as error:
            if self.saved is None:
                raise
            self._say(error, "statistics file")
        if run.facts or self.manifest is None:
            return run
        of_manifest = Run.of_manifest(self.manifest)
        last = max(run.last_episode_id, of_manifest.last_episode_id)
        return replace(of_manifest, count=run.count, last_episode_id=last)

    @functools.cached_property
    def with_deferred_video(self) -> set[int]:
        """The episodes whose videos are rendered from their states, now or later.

        Raises:
            UnreadableFile: see `run`.
        """
        return self.run.with_deferred_video

    @property
    def details(self) -> Mapping[str, Any]:
        """The facts that this package adds to a manifest; empty if there are none."""
        manifest = self.manifest
        return {} if manifest is None or manifest.mjrec is None else manifest.mjrec

    @property
    def env_info(self) -> Mapping[str, Any] | None:
        """The environment's facts in the manifest, journal or lock; None if unknown."""
        with contextlib.suppress(UnreadableFile):
            if self.manifest is not None:
                return self.manifest.env_info
        run: Mapping[str, Any] = {}
        with contextlib.suppress(UnreadableFile):
            run = self.run.facts
        if not run.get("env_info") and self.files.lock is not None:
            with contextlib.suppress(OSError, ValueError):
                run = locked_run(self.files.lock)
        info = run.get("env_info")
        is_info = isinstance(info, Mapping) and isinstance(info.get("env_id"), str)
        return info if is_info else None

    @property
    def is_behind(self) -> bool:
        """Whether the journal has episodes that the statistics file lacks.

        Raises:
            UnreadableFile: the journal cannot be read, and there are no statistics.
        """
        saved = self.saved
        return saved is None or self.run.count > len(saved.timestamps)

    def stats(self) -> StatsFile:
        """Return the statistics from the journal or the file with more episodes.

        Raises:
            UnreadableFile: neither file can be read.
        """
        saved, journal = self.saved, self.files.journal
        if journal is not None and self.is_behind:
            return _stats_of([*read_journal(journal, warns=True)], saved)
        return StatsFile(None, (), (), (), ()) if saved is None else saved

    def _read(self, path: Path | None, read: Callable[[Path], T]) -> T | None:
        try:
            return None if path is None else read(path)
        except UnreadableFile as error:
            if self.files.journal is None:
                raise
            self._say(error, "journal")
            return None

    def _say(self, error: UnreadableFile, instead: str) -> None:
        if error.path not in self._said:
            self._said.add(error.path)
            logger.warning("%s The monitor's %s is used instead.", error, instead)


def locked_run(path: Path) -> Mapping[str, Any]:
    """Return the facts about a monitor's run that its lock contains.

    Raises:
        OSError, ValueError: the lock cannot be read.
    """
    # A lock file is briefly empty after it is created. Links are not followed.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        run = json_object(os.read(descriptor, _LONGEST_LOCK)).get("run")
    finally:
        os.close(descriptor)
    return run if isinstance(run, Mapping) else {}


def _stats_of(entries: list[JournalEntry], saved: StatsFile | None) -> StatsFile:
    """Return the statistics about a journal's episodes."""
    # Prefer the saved time, because the first episode may never have ended.
    start = None if saved is None else saved.initial_reset_timestamp
    if start is None:
        starts = (entry.start_time for entry in entries)
        start = min((s for s in starts if not math.isnan(s)), default=None)
    return StatsFile(
        initial_reset_timestamp=start,
        timestamps=tuple(entry.end_time for entry in entries),
        episode_lengths=tuple(entry.length for entry in entries),
        episode_rewards=tuple(entry.reward for entry in entries),
        episode_types=tuple(entry.type for entry in entries),
    )

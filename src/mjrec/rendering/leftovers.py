# SPDX-License-Identifier: Apache-2.0
"""Files that a monitor left unfinished when it ended.

Only names, locks and the journal are examined, because every `resume` does this in the
simulation's process.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..errors import UnreadableFile
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    VideoName,
    final_name,
    is_note,
    iter_monitor_files,
    unfinished_files,
)
from ..formats.spans import recordings_in
from ..formats.video_metadata import is_broken, metadata_path
from ..formats.video_sink import note_path
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, files_of, monitors_of

_SHARED_LOCK = re.compile(r"\.openaigym\.(recover|render\.\d+)\.lock")

# "video" is the note about a live video, "text" the frames of a text recording, and
# "stale" an unfinished file that no process will finish, or a dead process's lock.
# Leftovers are finished in this order, after the logs.
Kind = Literal["video", "text", "stale"]


@dataclass(frozen=True)
class RecoveredFile:
    """A file, and its state after a recovery.

    Attributes:
        name: the file's final base name.
        what: a description of what was done with the file, or why it failed.
    """

    name: str
    what: str

    def __str__(self) -> str:
        return f"{self.name}: {self.what}"


def logs_left(files: MonitorFiles) -> list[Path]:
    """Return the row logs of a monitor that contain episodes or can be removed."""
    return [log for log in sorted(files.logs) if _has_work(log)]


def leftovers(files: MonitorFiles, kind: Kind) -> list[Path]:
    """Return a monitor's leftover files of one kind."""
    return [path for path in files.paths if _kind_of(path, files) == kind]


def has_leftovers(files: MonitorFiles) -> bool:
    """Return whether a monitor has left any work to do."""
    is_left = bool(logs_left(files)) or any(_kind_of(p, files) for p in files.paths)
    return is_left or lacks_results(files)


def is_at_work(directory: Path, infix: str) -> bool:
    """Return whether a process still encodes or renders for a dead monitor."""
    files = files_of(directory, infix)
    hidden = [path for path in files.paths if path.name.startswith(".")]
    return any(is_locked(path) for path in hidden if path != files.lock)


def stale_shared_files(directory: Path) -> list[Path]:
    """Return the stale files in a directory that do not belong to a single monitor.

    These are locks and, unless a monitor is open, unfinished model files.
    """
    # List the files before looking at locks, because any process that is working on a
    # listed file already held its lock then.
    hidden = [p for p in iter_monitor_files(directory, hidden=True) if p.name[0] == "."]
    models = [path for path in hidden if path.name.startswith(".openaigym.model.")]
    if models and any(files.is_open for files in monitors_of(directory)):
        models = []
    locks = [path for path in hidden if _SHARED_LOCK.fullmatch(path.name)]
    return models + [path for path in locks if not is_locked(path)]


def _has_work(log: Path) -> bool:
    """Return whether a log must be finished or removed."""
    try:
        in_flight = [each for each in recordings_in(log) if each.is_in_flight]
    except UnreadableFile:
        return True
    # Clips stay in the log until their video is rendered.
    return not in_flight or any(each.path.suffix == ".h5" for each in in_flight)


def _kind_of(path: Path, files: MonitorFiles) -> Kind | None:
    """Return the kind of a leftover file; None if there is nothing to do with it."""
    if path.suffix == ".lock" and path != files.lock:
        return None if is_locked(path) else "stale"
    final = final_name(path.name)
    if final is None:
        return None
    video = path.with_name(final)
    if is_note(path.name):
        # The data of a broken video is kept, in case it can be repaired.
        return None if is_broken(metadata_path(video)) else "video"
    name = VideoName.parse(final)
    if name is None:
        return "stale"
    mp4 = path.with_name(name.video)
    if note_path(mp4).exists() and final.endswith((".mp4", ".framehash")):
        return None
    # A clip's video may have the name of an episode's video.
    clips = f".openaigym.clip.{files.infix}."
    locks = [p for p in files.paths if p.name.startswith(clips)]
    locks.append(mp4.with_name(f".{mp4.stem}.lock"))
    if any(map(is_locked, [*unfinished_files(mp4), *locks])):
        return None
    return "text" if name.is_episodes and name.ending == "json" else "stale"


def lacks_results(files: MonitorFiles) -> bool:
    """Return whether the statistics or the manifest are missing, or may be outdated.

    A monitor that closed normally wrote both and removed its lock.
    """
    if files.lock is not None:
        return True
    if files.manifest is None:
        # gym's own recordings have no journal or trajectory, and their manifests cannot
        # be recreated.
        return bool(files.journal or files.trajectories)
    try:
        results = MonitorResults(files)
        is_damaged = results.manifest is None
        return files.journal is not None and (is_damaged or results.is_behind)
    except UnreadableFile:
        return True

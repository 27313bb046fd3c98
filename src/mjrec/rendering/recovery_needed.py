# SPDX-License-Identifier: Apache-2.0
"""What a monitor that ended early has left for `recover` to finish or remove.

Only names, locks and the journal are examined, because every `resume` does this in the
simulation's process.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..errors import UnreadableFile
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    VideoName,
    final_name,
    is_note,
    iter_monitor_files,
    unfinished_files,
    view_of,
)
from ..formats.spans import recordings_in
from ..formats.video_metadata import is_broken, metadata_path
from ..formats.video_sink import note_path
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, files_of, monitors_of

_SHARED_LOCK = re.compile(r"\.openaigym\.(recover|render\.\d+)\.lock")


def logs_left(files: MonitorFiles) -> list[Path]:
    """Return the row logs of a monitor that contain episodes or can be removed."""
    return [log for log in sorted(files.logs) if _has_work(log)]


def live_videos_left(files: MonitorFiles) -> list[Path]:
    """Return the unfinished live videos of a monitor, an episode's first one last.

    The first camera's metadata lists the other videos.
    """
    notes = [path for path in files.paths if is_note(path.name)]
    videos = [path.with_name(final_name(path.name) or "") for path in notes]
    # The data of a broken video is kept, in case it can be repaired.
    left = [path for path in videos if not is_broken(metadata_path(path))]
    return sorted(left, key=lambda path: not view_of(path.name))


def needs_recovery(files: MonitorFiles) -> bool:
    """Return whether a monitor has left any work to do."""
    found = logs_left(files) or live_videos_left(files) or stale_files(files)
    return bool(found) or lacks_results(files)


def is_encoding(directory: Path, infix: str) -> bool:
    """Return whether an encoder is still completing a live video of a dead monitor."""
    videos = live_videos_left(files_of(directory, infix))
    return any(is_locked(part) for video in videos for part in unfinished_files(video))


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


def stale_files(files: MonitorFiles) -> list[Path]:
    """Return a monitor's files to remove: locks that no process holds, and parts.

    These are parts of files that no process will finish.
    """
    return [path for path in files.paths if _is_stale(path, files)]


def _is_stale(path: Path, files: MonitorFiles) -> bool:
    if path.suffix == ".lock":
        return path != files.lock and not is_locked(path)
    final = final_name(path.name)
    if final is None or is_note(path.name):
        return False
    name = VideoName.parse(final)
    if name is None:
        return True
    mp4 = path.with_name(name.video)
    notes = map(note_path, (mp4, mp4.with_suffix(".json")))
    if name.ending in ("mp4", "json", "framehash") and any(map(Path.exists, notes)):
        return False
    # A clip's video may have the name of an episode's video.
    clips = f".openaigym.clip.{files.infix}."
    locks = [p for p in files.paths if p.name.startswith(clips)]
    locks.append(mp4.with_name(f".{mp4.stem}.lock"))
    return not any(map(is_locked, [*unfinished_files(mp4), *locks]))


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

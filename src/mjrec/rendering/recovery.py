# SPDX-License-Identifier: Apache-2.0
"""`mjrec.recover`: finish the files that killed processes left in a directory.

To find them, only names, locks and the journal are examined, because every `resume`
does this in the simulation's process.
"""

from __future__ import annotations

import math
import numbers
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..errors import DirectoryNotWritable, InvalidArgument, UnreadableFile
from ..formats.locks import is_locked, wait_for_lock
from ..formats.monitor_directory import (
    Infix,
    VideoName,
    final_name,
    is_note,
    iter_monitor_files,
    unfinished_files,
)
from ..formats.second_names import give_all_second_names
from ..formats.spans import recordings_in
from ..formats.unfinished_video import note_path
from ..formats.video_metadata import is_broken, metadata_path
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, files_of, monitors_of

# Only one process at a time recovers a directory.
_LOCK = ".openaigym.recover.lock"
_SECONDS = 5.0
_MOMENT = 0.05
_SHARED_LOCK = re.compile(r"\.openaigym\.(recover|render\.\d+)\.lock")

# "video" is the note of a live video, "text" the frames of a text recording, and
# "stale" an unfinished file that no process will finish, or a dead process's lock.
# Leftovers are finished in this order, after the logs.
Kind = Literal["video", "text", "stale"]


@dataclass(frozen=True)
class RecoveredFile:
    """A file, and its state after a recovery.

    Attributes:
        name: the file's final base name.
        what: a description of what was done, or why it failed.
    """

    name: str
    what: str

    def __str__(self) -> str:
        return f"{self.name}: {self.what}"


@dataclass(frozen=True)
class Recovery:
    """The result of `recover`. It is false if there was nothing to do.

    Attributes:
        directory: the directory.
        files: files that were finished.
        failures: files that could not be finished, with the reasons. They are
            unchanged.
        open_monitors: infixes of monitors that are still recording. Their files were
            left alone.
    """

    directory: Path
    files: tuple[RecoveredFile, ...] = ()
    failures: tuple[RecoveredFile, ...] = ()
    open_monitors: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.files or self.failures)

    def __str__(self) -> str:
        if not self:
            lines = [f"Nothing to recover in {self.directory}."]
        elif not self.files:
            lines = [f"Nothing could be recovered in {self.directory}."]
        else:
            lines = [f"Recovered in {self.directory}:"]
        lines += [f"  {file}" for file in self.files]
        if self.failures:
            lines += ["Not recovered:", *(f"  {file}" for file in self.failures)]
        if self.open_monitors:
            listed = ", ".join(self.open_monitors)
            lines += [f"Still recording, and left alone: {listed}."]
        return "\n".join(lines)


def recover(
    directory: str | os.PathLike[str],
    *,
    timeout: float = _SECONDS,
    bundle: bool = False,
) -> Recovery:
    """Finish what killed monitors or renderers left in a directory.

    Live videos get their final names, and metadata with `complete: false` and `reason:
    "killed"`. Logs become trajectories with the same facts. Statistics and manifest are
    written from the journal. Unfinished files of dead processes are removed. Deferred
    videos stay pending: render them with `mjrec render DIR`. Files of open monitors and
    running renderers are left alone. `docs/howto/recovery.md` has the details.

    It can be killed at any moment and repeated. A second run does nothing.

    Args:
        directory: the monitor directory.
        timeout: total number of seconds to wait for encoders that are still finishing
            a dead process's files.
        bundle: put the trajectories from a monitor's logs into one file, as an
            evaluation does.

    Returns:
        The finished files and the failures. A failure does not stop the rest.

    Raises:
        InvalidArgument: the directory does not exist, or `timeout` is invalid.
        DirectoryNotWritable: the directory is read-only, and there is something to do.
    """
    path = Path(directory).absolute()
    is_number = isinstance(timeout, numbers.Real) and not isinstance(timeout, bool)
    if not is_number or not 0 <= timeout < math.inf:
        raise InvalidArgument(
            f"timeout must be a number of seconds, 0 or more, got {timeout!r}."
        )
    deadline = time.monotonic() + timeout
    if not path.is_dir():
        raise InvalidArgument(f"Cannot recover {path}: it is not a directory.")
    dead, open_monitors = _dead_and_open(path)
    # While another process recovers, it holds the locks of dead monitors, which then
    # look open.
    if not (dead or stale_shared_files(path) or is_locked(path / _LOCK)):
        return Recovery(path, open_monitors=open_monitors)
    # Not imported at the top: it loads HDF5, which a simulation that resumes after a
    # closed monitor does not need.
    from .killed_monitor import Report, finish_killed_monitor

    report = Report()
    if not os.access(path, os.W_OK | os.X_OK):
        raise DirectoryNotWritable(path, "permission denied")
    # Wait for encoders before taking any lock.
    while time.monotonic() < deadline and any(is_at_work(path, each) for each in dead):
        time.sleep(_MOMENT)
    with wait_for_lock(path / _LOCK):
        # Look again, because another process may have recovered them meanwhile.
        dead, open_monitors = _dead_and_open(path)
        for infix in dead:
            finish_killed_monitor(path, infix, report, bundles=bundle)
        for stale in stale_shared_files(path):
            report.remove(stale)
        give_all_second_names(path)
    return Recovery(path, (*report.files,), (*report.failures,), open_monitors)


def _dead_and_open(directory: Path) -> tuple[list[Infix], tuple[str, ...]]:
    """Return the dead monitors that need work, and the infixes of open monitors."""
    dead: list[Infix] = []
    still_open: list[str] = []
    for files in monitors_of(directory):
        infix = Infix.parse(files.infix)
        try:
            if infix is None:
                continue
            if files.is_open:
                still_open.append(files.infix)
            elif has_leftovers(files):
                dead.append(infix)
        except OSError as error:
            raise DirectoryNotWritable(directory, error.strerror) from error
    return dead, tuple(still_open)


def logs_left(files: MonitorFiles) -> list[Path]:
    """Return the row logs of a monitor that contain episodes, or are useless."""
    return [log for log in sorted(files.logs) if _has_work(log)]


def leftovers(files: MonitorFiles, kind: Kind) -> list[Path]:
    """Return a monitor's leftover files of one kind."""
    return [path for path in files.paths if _kind_of(path, files) == kind]


def has_leftovers(files: MonitorFiles) -> bool:
    """Return whether a monitor has left anything to do."""
    is_left = bool(logs_left(files)) or any(_kind_of(p, files) for p in files.paths)
    return is_left or lacks_results(files)


def is_at_work(directory: Path, infix: Infix) -> bool:
    """Return whether an encoder or renderer still works on a dead monitor's files."""
    files = files_of(directory, infix)
    hidden = [path for path in files.paths if path.name.startswith(".")]
    return any(is_locked(path) for path in hidden if path != files.lock)


def stale_shared_files(directory: Path) -> list[Path]:
    """Return the stale files that belong to no single monitor of a directory.

    These are unfinished model files, unless a monitor is open, and locks.
    """
    # List the files before looking at locks: a process that is working on a listed
    # file has held its lock since before.
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
    """Return the kind of a leftover file; None if nothing must be done about it."""
    if path.suffix == ".lock" and path != files.lock:
        return None if is_locked(path) else "stale"
    final = final_name(path.name)
    if final is None:
        return None
    video = path.with_name(final)
    if is_note(path.name):
        # The data of a broken video stays, in case someone can repair it.
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
    if any(map(is_locked, [*unfinished_files(mp4), *locks, _lock_of(mp4)])):
        return None
    return "text" if name.is_episodes and name.ending == "json" else "stale"


def _lock_of(video: Path) -> Path:
    return video.with_name(f".{video.stem}.lock")


def lacks_results(files: MonitorFiles) -> bool:
    """Return whether statistics or manifest are missing, or may be outdated.

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

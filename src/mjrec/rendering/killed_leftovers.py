# SPDX-License-Identifier: Apache-2.0
"""Looking for what killed processes have left in a directory.

Only names and locks are looked at, and the episodes of journals counted: it is done at
each `resume`, in the process of the simulation.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..errors import UnreadableFile
from ..formats.locks import is_locked
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    clip_lock_name,
    infix_of,
    iter_monitor_files,
    lock_name,
    names_in,
    video_prefix,
)
from ..formats.spans import SPANS, read_list
from ..formats.unfinished_video import note_path
from ..formats.video_metadata import is_broken, metadata_path
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles

# A note is rewritten as every file is: an unfinished one has both endings.
_PART = re.compile(
    r"\.(?P<final>openaigym\..+?)(?:\.note\.part\.[0-9a-f]{8}|\.[0-9a-f]{8}|\.note)\.part"
)
_MODEL_PART = re.compile(r"\.openaigym\.model\..+\.[0-9a-f]{8}\.part")
_VIDEO_PART = re.compile(
    r"\.(?P<video>openaigym\.video\..+\.video\d{6,}(?:\.[^/]+)?)"
    r"\.(?P<kind>mp4|framehash|json|meta\.json)\.[0-9a-f]{8}\.part"
)
_FIRST_NOTE = re.compile(r"\.video\d{6,}\.[a-z0-9]+\.note\.part$")


@dataclass(frozen=True)
class Remains:
    """The files of one monitor, hidden ones too.

    Attributes:
        directory: where they are.
        infix: the monitor's.
        paths: the files, sorted by name.
    """

    directory: Path
    infix: Infix
    paths: tuple[Path, ...]

    @functools.cached_property
    def files(self) -> MonitorFiles:
        """The files as results are read from them."""
        return MonitorFiles(str(self.infix), self.known_paths)

    @property
    def lock(self) -> Path:
        """What the monitor claimed its infix with, be it there or not."""
        return self.directory / lock_name(self.infix)

    @property
    def logs(self) -> list[Path]:
        """The files that its episodes in flight will become."""
        return [path for path in self._in_flight if path.suffix == ".h5"]

    @property
    def clip_parts(self) -> list[Path]:
        """What the parts of videos are called that are counted in steps."""
        return [path for path in self._in_flight if path.suffix != ".h5"]

    @property
    def damaged_lists(self) -> list[Path]:
        """Lists of spans that nobody can read."""
        return [path for path in self.paths if path.suffix == SPANS and _is_bad(path)]

    @property
    def idle_lists(self) -> list[Path]:
        """Lists of spans that nobody needs any more."""
        lists = (path for path in self.paths if path.suffix == SPANS)
        return [p for p in lists if not _is_bad(p) and not read_list(p).in_flight()]

    @property
    def _in_flight(self) -> list[Path]:
        lists = (path for path in self.paths if path.suffix == SPANS)
        found = (read_list(path).in_flight() for path in lists if not _is_bad(path))
        return [each.path for recordings in found for each in recordings]

    @property
    def known_paths(self) -> tuple[Path, ...]:
        """The files, and those that recordings in flight will become."""
        return (*self.paths, *self.logs)

    @property
    def notes(self) -> list[Path]:
        """The notes of unfinished videos that something can be done about."""
        return [
            path
            for path in self.paths
            if path.name.endswith(".note.part") and not _is_given_up(path)
        ]

    @property
    def texts(self) -> list[Path]:
        """The unfinished text recordings, in which there may be frames."""
        return [
            path
            for path in self.paths
            if (match := _VIDEO_PART.fullmatch(path.name))
            and match["kind"] == "json"
            and self.is_own_video(path)
            and _begins_with_frame(path)
        ]

    @property
    def leftovers(self) -> list[Path]:
        """Unfinished files that will never be finished."""
        kept = {path.name for path in self.paths if path.name.endswith(".note.part")}
        return [
            path
            for path in self.paths
            if path.suffix == ".part"
            and path.name not in kept
            and not _has_note(path, kept)
            and not self._is_held(path)
        ]

    def is_own_video(self, part: Path) -> bool:
        """Tell whether an unfinished file is of a video as it was to be at first."""
        match = _VIDEO_PART.fullmatch(part.name)
        return match is not None and match["video"].rpartition(".video")[2].isdigit()

    def is_first_video(self, note: Path) -> bool:
        """Tell whether a note is of the first video of its episode."""
        return _FIRST_NOTE.search(note.name) is not None

    def _is_held(self, part: Path) -> bool:
        """Tell whether an unfinished file may be somebody's who is alive."""
        match = _VIDEO_PART.fullmatch(part.name)
        if match is None:
            return False
        number = int(re.findall(r"\.video(\d{6,})", part.name)[-1])
        if self.is_own_video(part):
            renderer = f".{video_prefix(self.infix, number)}.lock"
            return is_locked(self.directory / renderer) or self._renders_clip()
        # Of an episode that is rendered once more. Its metadata, which nobody holds,
        # is there for a moment only.
        siblings = [
            path
            for path in self.paths
            if path.name.startswith(f".{match['video']}.mp4.")
        ]
        return match["kind"] == "meta.json" or any(map(is_locked, siblings))

    def _renders_clip(self) -> bool:
        """Tell whether somebody is at a clip, whose video may be called as others."""
        parts = (ClipPart.parse(path.name) for path in self.clip_parts)
        locks = {clip_lock_name(self.infix, part.first_step) for part in parts if part}
        return any(is_locked(self.directory / name) for name in locks)


def remains_of(directory: Path) -> list[Remains]:
    """Return the files of all monitors, those that are open too."""
    grouped: dict[Infix, list[Path]] = {}
    for path in iter_monitor_files(directory, hidden=True):
        infix = _infix_of(path.name)
        if infix is not None:
            grouped.setdefault(infix, []).append(path)
    return [
        Remains(directory, infix, tuple(grouped[infix]))
        for infix in sorted(grouped, key=lambda infix: (infix.monitor_id, infix.uid))
    ]


def look_through(directory: Path, infix: Infix) -> Remains:
    """Return the files of one monitor as they are now."""
    # Many names are compared, of whole directories, once for each dead monitor.
    own = f".{infix}."
    paths = [
        path
        for name in names_in(directory)
        if own in name
        and _infix_of(name) == infix
        and (path := directory / name).is_file()
    ]
    return Remains(directory, infix, tuple(sorted(paths)))


def model_leftovers(directory: Path) -> list[Path]:
    """Return the unfinished files of models that nobody will finish.

    They belong to all monitors of a directory, so there are none while one is open.
    """
    # In this order: whoever is at one of them has held a lock since before.
    parts = [
        path
        for path in iter_monitor_files(directory, hidden=True)
        if _MODEL_PART.fullmatch(path.name)
    ]
    return [] if parts and any(map(is_open, remains_of(directory))) else parts


def is_open(remains: Remains) -> bool:
    """Tell whether a living process holds the monitor's lock."""
    return is_locked(remains.lock)


def has_work(remains: Remains) -> bool:
    """Tell whether anything is to be put in order, of a monitor that is not open."""
    unfinished = remains.notes or remains.leftovers or unfinished_logs(remains)
    lists = remains.damaged_lists or remains.idle_lists
    return bool(unfinished or lists or lacks_results(remains))


def unfinished_logs(remains: Remains) -> list[Path]:
    """Return the files of episodes in flight that are to get their final form.

    Those of a monitor that closed and left the choice among them to somebody else
    wait for that.
    """
    logs = remains.logs
    if not logs or remains.lock in remains.paths or remains.files.manifest is None:
        return logs
    try:
        details = read_manifest(remains.files.manifest).mjrec or {}
    except UnreadableFile:
        return logs
    keep = details.get("keep")
    is_left = isinstance(keep, Mapping) and keep.get("left_open") is True
    return [] if is_left else logs


def lacks_results(remains: Remains) -> bool:
    """Tell whether statistics or manifest are missing, or may be older than the rest.

    A monitor that has closed wrote both, and removed its lock.
    """
    files = remains.files
    if remains.lock in remains.paths:
        return True
    if files.manifest is None:
        # Gym's own never had these, and its manifests cannot be made again.
        return bool(files.journal or files.trajectories)
    try:
        results = MonitorResults(files)
        is_damaged = results.manifest is None
        return files.journal is not None and (is_damaged or results.is_behind)
    except UnreadableFile:
        return True


def _infix_of(name: str) -> Infix | None:
    part = _PART.fullmatch(name)
    return Infix.parse(infix_of(part["final"] if part else name) or "")


def _is_bad(path: Path) -> bool:
    try:
        return read_list(path).is_headless
    except UnreadableFile:
        return True


def _begins_with_frame(part: Path) -> bool:
    """Tell whether a file is the frames of a text recording, not the whole of one."""
    with part.open("rb") as file:
        return file.read(1) == b"["


def _is_given_up(note: Path) -> bool:
    name = note.name.removeprefix(".").removesuffix(".note.part")
    return is_broken(metadata_path(note.with_name(name)))


def _has_note(part: Path, notes: set[str]) -> bool:
    match = _VIDEO_PART.fullmatch(part.name)
    if match is None or match["kind"] not in ("mp4", "framehash"):
        return False
    return note_path(part.with_name(f"{match['video']}.mp4")).name in notes

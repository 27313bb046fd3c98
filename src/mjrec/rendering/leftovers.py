# SPDX-License-Identifier: Apache-2.0
"""What killed processes have left in a directory, monitor by monitor.

Only names and locks are looked at, and the episodes of journals counted: it is done at
each `resume`, in the process of the simulation.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import UnreadableFile
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    Infix,
    infix_of,
    iter_monitor_files,
    lock_name,
    names_in,
)
from ..formats.spans import SPANS, Recording, SpanList, read_list
from ..formats.unfinished_video import note_path
from ..formats.video_metadata import is_broken, metadata_path
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles

# A note is rewritten as every file is: an unfinished one has both endings.
_PART = re.compile(
    r"\.(?P<final>openaigym\..+?)(?P<note>\.note(\.part)?)?(?P<hex>\.[0-9a-f]{8})?\.part"
)
_MODEL_PART = re.compile(r"\.openaigym\.model\..+\.[0-9a-f]{8}\.part")
_VIDEO = re.compile(
    r"(?P<stem>openaigym\.video\..+)\.(?P<kind>mp4|framehash|meta\.json|json)"
)
_TEXT = re.compile(r"openaigym\.video\..+\.video\d{6,}\.json")


@dataclass(frozen=True)
class Leftovers:
    """The files of one monitor, hidden ones too, and what is left to do about them.

    Attributes:
        directory: where they are.
        infix: the monitor's.
        paths: the files, sorted by name.
        lists: its lists of spans.
        damaged_lists: those that cannot be read, and why.
    """

    directory: Path
    infix: Infix
    paths: tuple[Path, ...]
    lists: dict[Path, SpanList] = field(init=False, default_factory=dict)
    damaged_lists: dict[Path, str] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        for path in self.paths:
            if path.suffix == SPANS:
                try:
                    spans = self.lists[path] = read_list(path)
                    if spans.is_headless:
                        raise UnreadableFile(path, "it does not say what its rows are")
                except UnreadableFile as error:
                    self.lists.pop(path, None)
                    self.damaged_lists[path] = str(error)

    @functools.cached_property
    def files(self) -> MonitorFiles:
        """The files as results are read from them, with those that logs will become."""
        logs = [each.path for each in self.in_flight if each.path.suffix == ".h5"]
        return MonitorFiles(str(self.infix), (*self.paths, *logs))

    @property
    def lock(self) -> Path:
        """What the monitor claimed its infix with; it may not be there."""
        return self.directory / lock_name(self.infix)

    @property
    def is_open(self) -> bool:
        """Whether a living process holds the monitor's lock."""
        return is_locked(self.lock)

    @functools.cached_property
    def in_flight(self) -> list[Recording]:
        """The recordings that only logs have."""
        return [each for spans in self.lists.values() for each in spans.in_flight()]

    @property
    def idle_lists(self) -> list[Path]:
        """Lists of spans that are not needed any more."""
        return [path for path, spans in self.lists.items() if not spans.in_flight()]

    @property
    def unfinished_logs(self) -> list[Path]:
        """The files of episodes in flight that are to get their final form."""
        return [each.path for each in self.in_flight if each.path.suffix == ".h5"]

    @property
    def unfinished_files(self) -> dict[Path, str]:
        """Hidden files that no process is at, each with what is to be done about it.

        ============================================== ========
        the note of a live video                       "video"
        ... of one whose metadata says it is broken    (stays)
        its mp4 and its frame hashes                   (with the note)
        the frames of a text recording                 "text"
        every other unfinished file                    "remove"
        ============================================== ========
        """
        found: dict[Path, str] = {}
        for path in self.paths:
            match = _PART.fullmatch(path.name)
            if match is None:
                continue
            final, video = match["final"], _VIDEO.fullmatch(match["final"])
            is_note = match["note"] and not match["hex"]
            if is_note and not is_broken(metadata_path(path.with_name(final))):
                found[path] = "video"
            elif is_note or (video is not None and self._is_held(video)):
                continue
            elif _TEXT.fullmatch(final):
                found[path] = "text"
            elif video is None or not self._has_note(video):
                found[path] = "remove"
        return found

    @property
    def lacks_results(self) -> bool:
        """Whether statistics or manifest are missing, or may be older than the rest.

        A monitor that has closed wrote both, and removed its lock.
        """
        files = self.files
        if self.lock in self.paths:
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

    @property
    def has_work(self) -> bool:
        """Whether anything is to be put in order, of a monitor that is not open."""
        return bool(
            self.unfinished_files
            or self.unfinished_logs
            or self.idle_lists
            or self.damaged_lists
            or self.lacks_results
        )

    def _is_held(self, video: re.Match[str]) -> bool:
        """Tell whether a living process may be at a video, or at any clip.

        A clip's video may be called as an episode's.
        """
        stem = video["stem"]
        begins = (f".{stem}.lock", f".{stem}.mp4.", f".openaigym.clip.{self.infix}.")
        return any(is_locked(p) for p in self.paths if p.name.startswith(begins))

    def _has_note(self, video: re.Match[str]) -> bool:
        is_noted = video["kind"] in ("mp4", "framehash")
        note = note_path(self.directory / f"{video['stem']}.mp4")
        return is_noted and note in self.paths


def leftovers_in(directory: Path) -> list[Leftovers]:
    """Return the files of all monitors, those that are open too."""
    grouped: dict[Infix, list[Path]] = {}
    for path in iter_monitor_files(directory, hidden=True):
        infix = _infix_of(path.name)
        if infix is not None:
            grouped.setdefault(infix, []).append(path)
    return [
        Leftovers(directory, infix, tuple(grouped[infix]))
        for infix in sorted(grouped, key=lambda infix: (infix.monitor_id, infix.uid))
    ]


def leftovers_of(directory: Path, infix: Infix) -> Leftovers:
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
    return Leftovers(directory, infix, tuple(sorted(paths)))


def model_leftovers(directory: Path) -> list[Path]:
    """Return the unfinished files of models that no process will finish.

    They belong to all monitors of a directory, so there are none while one is open.
    """
    # In this order: a process that is at one of them has held a lock since before.
    parts = [
        path
        for path in iter_monitor_files(directory, hidden=True)
        if _MODEL_PART.fullmatch(path.name)
    ]
    is_open = parts and any(each.is_open for each in leftovers_in(directory))
    return [] if is_open else parts


def _infix_of(name: str) -> Infix | None:
    part = _PART.fullmatch(name)
    return Infix.parse(infix_of(part["final"] if part else name) or "")

# SPDX-License-Identifier: Apache-2.0
"""The mapping from rows in a monitor's logs to recordings, read from the journal.

A recording in flight is a span of rows: an episode, or the part of a clip in one
episode. The journal has a line for each event::

    {"rows": {"number": 0, "version": 1, "dtype": [["row", "<i8"], ...], "facts": {}}}
    {"begin": {"name": "openaigym.trajectory.0.7.episode000027", "log": 3, "rows": 0,
               "row": 54, "look": 0, "facts": {...}, "without": [...]}}
    {"note": {"name": "openaigym.trajectory.0.7.episode000027", "facts": {...}}}
    {"end": {"name": "openaigym.trajectory.0.7.episode000027", "row": 77,
             "facts": {...}}}
    {"drop": "openaigym.trajectory.0.7.episode000027"}
    {"full": 3}

`rows` gives the layout of rows, and the facts that all recordings with this layout
share unless `begin` overrides them or lists them in `without`. A span without an end
extends to the last row. Log 3 is `openaigym.states.<infix>.000003.log`; the `.looks`
file next to it contains the changes to the model. These files are removed once every
recording in them has been dropped or exists in its final form: an episode as a
trajectory, or only as a video if its trajectory is not kept.

A recording is identified by the path of the file that it will become.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import DirectoryNotWritable, UnreadableFile
from .bundle import FINISHED, is_finished
from .journal import count, is_of_spans
from .json_fields import base_name, integer, json_object, mapping, unreadable
from .locks import is_locked
from .monitor_directory import (
    clip_step,
    episode_of,
    infix_of,
    journal_name,
    lock_name,
    log_name,
    log_number,
    names_in,
    trajectory_prefix,
)
from .regular_files import open_regular
from .row_log import has_rows, tail_path
from .trajectory import check_version, dtype_from_json
from .video_metadata import is_done

LOG, LOOKS = ".log", ".looks"

_LONGEST_LINE = 1 << 24
# Reading resumes where it stopped only if this many preceding bytes are unchanged.
_SEAM = 128


@dataclass
class Recording:
    """A recording whose rows are in a log, according to the journal so far.

    Attributes:
        name: the recording's file name without suffix.
        log: its row log.
        rows: the journal's `rows` event for its rows.
        facts: all known facts.
        row: the number of its first row.
        look: offset of its changes to the model in the `.looks` file.
        stop: one more than the number of its last row; None if it has not ended.
        following: the first row of the next recording in the log; None for the last
            recording.
        is_dropped: whether its rows were discarded.
    """

    name: str
    log: Path
    rows: Mapping[str, Any]
    facts: dict[str, Any]
    row: int
    look: int
    stop: int | None = None
    following: int | None = None
    is_dropped: bool = False

    @property
    def path(self) -> Path:
        """The recording's path: for an episode, that of the file it will become."""
        is_episode = episode_of(f"{self.name}{FINISHED}") is not None
        return self.log.with_name(f"{self.name}{FINISHED * is_episode}")

    @functools.cached_property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of the recording's rows.

        Raises:
            UnreadableFile: the journal lacks the dtype, or has a newer version.
        """
        with unreadable(_journal_of(self.log)):
            if not self.rows:
                raise ValueError("it does not give the layout of the rows in its logs")
            check_version(integer(self.rows.get("version")))
            return dtype_from_json(self.rows.get("dtype"))

    @property
    def is_gone(self) -> bool:
        """Whether the recording's rows are no longer needed.

        This is True if the recording was dropped, or if its trajectory is not kept and
        its video is finished or was given up.
        """
        if self.is_dropped or self.facts.get("kept") is not False:
            return self.is_dropped
        video = self.facts.get("video")
        name = video.get("name") if isinstance(video, dict) else None
        with contextlib.suppress(ValueError):
            return is_done(self.log.with_name(base_name(name)))
        return False

    @property
    def is_in_flight(self) -> bool:
        """Whether the recording exists only in its log."""
        return not is_finished(self.path) and not self.is_gone

    @property
    def last_write(self) -> float:
        """The time when the log's last row was written, in seconds since the epoch."""
        files = (self.log, tail_path(self.log))
        return max((f.stat().st_mtime for f in files if f.exists()), default=0.0)


@dataclass
class _Spans:
    """The events about rows in the part of a journal that has been read.

    Attributes:
        journal: the file.
        logs: the recordings in each existing log, in the order of their rows.
        recordings: the newest of these recordings for each name.
        full: the logs that receive no more rows.
    """

    journal: Path
    logs: dict[Path, list[Recording]] = field(default_factory=dict)
    recordings: dict[str, Recording] = field(default_factory=dict)
    full: set[Path] = field(default_factory=set)
    _rows: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    _status: os.stat_result | None = None
    _offset: int = 0
    _seam: bytes = b""

    def goes_on_in(self, file: BinaryIO) -> bool:
        """Return whether `file` is the one read before, possibly with data appended."""
        before, now = self._status, os.fstat(file.fileno())
        if before is None or (before.st_dev, before.st_ino) != (now.st_dev, now.st_ino):
            return False
        file.seek(self._offset - len(self._seam))
        is_longer = now.st_size > before.st_size
        is_same = (before.st_size, before.st_mtime_ns) == (now.st_size, now.st_mtime_ns)
        return is_same or (is_longer and file.read(len(self._seam)) == self._seam)

    def read_on(self, file: BinaryIO) -> None:
        """Read the rest of a file, starting where the last read stopped."""
        self._status = os.fstat(file.fileno())
        file.seek(self._offset)
        began = self._offset
        # An incomplete line is still being written, or its writer was killed.
        while (line := file.readline(_LONGEST_LINE)).endswith(b"\n"):
            self._offset += len(line)
            self._seam = line[-_SEAM:]
            if is_of_spans(line):
                # An invalid line is ignored.
                with contextlib.suppress(ValueError, LookupError, TypeError):
                    self._take(json_object(line))
        if self._offset > began:
            self._forget_what_is_removed()

    def _forget_what_is_removed(self) -> None:
        self.logs = {log: each for log, each in self.logs.items() if log.exists()}
        self.full &= self.logs.keys()
        known = self.recordings.items()
        self.recordings = {name: each for name, each in known if each.log in self.logs}

    def _take(self, values: Mapping[str, Any]) -> None:
        [(kind, said)] = values.items()
        if kind == "rows":
            self._rows[integer(said["number"])] = mapping(said)
        elif kind == "begin":
            self._begin(said)
        elif kind == "full":
            self.full.add(self._log(said))
        elif kind == "drop":
            self.recordings[said].is_dropped = True
        elif kind == "note":
            self.recordings[said["name"]].facts.update(mapping(said["facts"]))
        elif kind == "end":
            recording = self.recordings[said["name"]]
            recording.stop = count(said["row"])
            recording.facts.update(mapping(said["facts"]))

    def _begin(self, said: Mapping[str, Any]) -> None:
        name, log = base_name(said["name"]), self._log(said["log"])
        if infix_of_recording(name) != infix_of(self.journal.name):
            raise ValueError(f"{name!r:.100} is not a recording of its monitor")
        rows, without = self._rows.get(said["rows"], {}), said.get("without", ())
        common = mapping(rows.get("facts", {})).items()
        facts = {k: v for k, v in common if k not in without}
        facts.update(mapping(said["facts"]))
        first, look = count(said["row"]), count(said["look"])
        recording = Recording(name, log, rows, facts, row=first, look=look)
        others = self.logs.setdefault(log, [])
        if others:
            others[-1].following = recording.row
        others.append(recording)
        if name in self.recordings:
            # The recording was begun a second time.
            self.recordings[name].is_dropped = True
        self.recordings[name] = recording

    def _log(self, number: Any) -> Path:
        infix = infix_of(self.journal.name)
        return self.journal.with_name(log_name(infix or "", count(number)))


# Cached because a journal only grows, and recordings are looked up one at a time. Each
# thread has its own cache: sharing one would require a lock, which is unsafe with fork.
_known = threading.local()
_MOST_KNOWN = 64


def _read(journal: Path) -> _Spans:
    """Return the current events about rows in a journal, which need not exist.

    Raises:
        UnreadableFile: the journal cannot be read.
    """
    known: dict[Path, _Spans] = vars(_known).setdefault("spans", {})
    # Removed from the cache first, so that an interrupted read starts over.
    spans = known.pop(journal, None) or _Spans(journal)
    with unreadable(journal):
        try:
            file = open_regular(journal)
        except (FileNotFoundError, NotADirectoryError):
            return _Spans(journal)
        with file:
            if not spans.goes_on_in(file):
                spans = _Spans(journal)
            spans.read_on(file)
    while len(known) >= _MOST_KNOWN:
        del known[next(iter(known))]
    known[journal] = spans
    return spans


def _journal_of(path: Path) -> Path:
    """Return the journal of the monitor that a file belongs to."""
    return path.with_name(journal_name(infix_of(path.name) or ""))


def infix_of_recording(name: str) -> str | None:
    """Return the infix in a recording's name, or None for any other name."""
    if clip_step(name) is not None:
        return infix_of(name)
    path = f"{name}{FINISHED}"
    return None if episode_of(path) is None else infix_of(path)


def log_paths(directory: Path, infix: str | None = None) -> Iterator[Path]:
    """Yield the paths of all logs in a directory, or of one monitor's logs.

    A log is included if any of its files exists.
    """
    logs = {
        directory / log_name(own, number)
        for name in names_in(directory)
        if (number := log_number(name)) is not None
        and (own := infix_of(name)) is not None
        and (infix is None or own == infix)
    }
    yield from sorted(logs)


def recordings_in(log: Path) -> list[Recording]:
    """Return the recordings in a log, in the order of their rows.

    Raises:
        UnreadableFile: the journal cannot be read, or does not give the layout of the
            log's rows.
    """
    found = _read(_journal_of(log)).logs.get(log, [])
    with unreadable(log):
        if not found and log.exists() and has_rows(log):
            raise ValueError("no journal gives the layout of its rows")
    for recording in found:
        # This raises an error if the layout is damaged.
        _ = recording.dtype
    return [*found]


def find_recording(path: Path) -> Recording | None:
    """Return the recording with this path if its rows are still needed, or None.

    Raises:
        UnreadableFile: the journal of its monitor cannot be read.
    """
    name = path.name.removesuffix(FINISHED)
    recording = _read(_journal_of(path)).recordings.get(name)
    if recording is None or recording.is_gone or not recording.log.exists():
        return None
    return recording


def find_trajectory(directory: Path, infix: str, episode_id: int) -> Path | None:
    """Return the path of an episode's own file, or None if it was not recorded."""
    path = directory / f"{trajectory_prefix(infix, episode_id)}{FINISHED}"
    return path if is_recorded(path) else None


def is_recorded(path: Path) -> bool:
    """Return whether a trajectory exists in any form, given the path of its own file.

    Raises:
        UnreadableFile: the journal of its monitor cannot be read.
    """
    return is_finished(path) or find_recording(path) is not None


def is_in_flight(path: Path) -> bool:
    """Return whether a recording exists only in a log, given the path of its file.

    Raises:
        UnreadableFile: the journal of its monitor cannot be read.
    """
    return not is_finished(path) and find_recording(path) is not None


def recordings_in_flight(directory: Path, infix: str | None = None) -> list[Recording]:
    """Return the recordings of one monitor, or of all, that exist only in logs.

    Unreadable logs are skipped; `recordings_in` reports the reason.
    """
    found: list[Recording] = []
    for log in log_paths(directory, infix):
        with contextlib.suppress(UnreadableFile):
            found += [each for each in recordings_in(log) if each.is_in_flight]
    return found


def remove_if_done(log: Path) -> None:
    """Remove a log if it receives no more rows and has no recordings in flight.

    Raises:
        DirectoryNotWritable: the log cannot be removed.
    """
    # Check this first, because a closed monitor begins no more recordings.
    is_open = _is_open(log)
    try:
        recordings = recordings_in(log)
        is_over = not is_open or log in _read(_journal_of(log)).full
    except UnreadableFile:
        return
    # Start with the last recording, because the first ones are finished first.
    if is_over and not any(each.is_in_flight for each in reversed(recordings)):
        remove_log(log)


def files_beside(log: Path) -> tuple[Path, ...]:
    """Return the files of a log, in the order in which to remove them."""
    # The log comes first, so that no reader opens it without the other files.
    return log, tail_path(log), log.with_suffix(LOOKS)


def remove_log(log: Path) -> None:
    """Remove a log and its companion files.

    Raises:
        DirectoryNotWritable: the files cannot be removed.
    """
    try:
        for each in files_beside(log):
            each.unlink(missing_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(log.parent, error) from error


def _is_open(log: Path) -> bool:
    infix = infix_of(log.name)
    try:
        return infix is not None and is_locked(log.parent / lock_name(infix))
    except OSError:
        # Its monitor may be open, so leave the log's files alone.
        return True

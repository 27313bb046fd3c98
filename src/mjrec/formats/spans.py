# SPDX-License-Identifier: Apache-2.0
"""Which rows of a monitor's logs are which recording.

A recording in flight is a span of rows: an episode, or a clip's part that is of one
episode. `openaigym.states.<infix>.<number>.spans` lists those of one row log, a line of
JSON each time something happens::

    {"format": "mjrec spans", "version": 1, "rows": [["row", "<i8"], ...], "facts": {}}
    {"begin": "openaigym.trajectory.0.7.episode000027", "row": 54, "look": 0,
     "facts": {...}, "without": [...]}
    {"note": "openaigym.trajectory.0.7.episode000027", "facts": {...}}
    {"end": "openaigym.trajectory.0.7.episode000027", "row": 77, "facts": {...}}
    {"drop": "openaigym.trajectory.0.7.episode000027"}
    {"closed": true}

The facts of the first line are those of every recording, as far as `begin` does not say
otherwise. A span without an end goes on to the last row. The `.log` beside it has the
rows, the `.looks` the changes of the model. When all recordings are dropped, or have
become files of their own, all of these are removed.

A recording is called by the path of the file that it will become.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DirectoryNotWritable, FileNotWritten, UnreadableFile
from ..json_text import dumps
from .appending import append_whole, open_for_appending
from .bundle import FINISHED, is_finished
from .json_fields import base_name, integer, json_object, mapping, unreadable
from .locks import is_locked
from .monitor_directory import (
    ClipPart,
    Infix,
    episode_of,
    infix_of,
    lock_name,
    names_in,
)
from .regular_files import open_regular, regular_path
from .row_log import tail_path
from .trajectory import check_version, dtype_from_json

FORMAT = "mjrec spans"
SPANS, LOG, LOOKS = ".spans", ".log", ".looks"


@dataclass
class Recording:
    """A recording in flight, as its list has it.

    Attributes:
        name: of its file without suffix.
        spans: the list that names it.
        facts: all that is known of it.
        row: its first.
        look: where to look for its changes of the model.
        stop: the row behind its last; None where it has not ended.
        is_dropped: its rows were given up.
    """

    name: str
    spans: SpanList
    facts: dict[str, Any]
    row: int
    look: int
    stop: int | None = None
    is_dropped: bool = False

    @property
    def path(self) -> Path:
        """What it is called: the file that an episode becomes."""
        is_episode = episode_of(f"{self.name}{FINISHED}") is not None
        return self.spans.path.with_name(f"{self.name}{FINISHED * is_episode}")

    @property
    def is_in_flight(self) -> bool:
        """Whether only the log has it."""
        return not self.is_dropped and not (
            self.path.suffix == FINISHED and is_finished(self.path)
        )


@dataclass
class SpanList:
    """A list of spans, as far as it was read.

    Attributes:
        path: of the list.
        dtype: of its rows; None before its first line is there.
        facts: of every recording.
        recordings: by their names, in the order of their rows.
        is_closed: no row is added any more.
    """

    path: Path
    dtype: np.dtype[Any] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    recordings: dict[str, Recording] = field(default_factory=dict)
    is_closed: bool = False

    @property
    def log(self) -> Path:
        """Its row log."""
        return self.path.with_suffix(LOG)

    @property
    def is_headless(self) -> bool:
        """Whether rows are there, and nothing says what they are."""
        rows = self.log.stat().st_size if self.log.exists() else 0
        return self.dtype is None and rows > 0

    @property
    def last_write(self) -> float:
        """When its last row was written, in seconds since the epoch."""
        files = (self.log, tail_path(self.log))
        return max((f.stat().st_mtime for f in files if f.exists()), default=0.0)

    def in_flight(self) -> list[Recording]:
        """Return the recordings that only the log has."""
        return [each for each in self.recordings.values() if each.is_in_flight]

    def _take(self, line: bytes) -> None:
        if self.dtype is None:
            values = json_object(line)
            if values.get("format") != FORMAT:
                raise ValueError("it is no list of spans")
            check_version(integer(values.get("version")))
            self.facts = mapping(values.get("facts"))
            self.dtype = dtype_from_json(values.get("rows"))
            return
        # The end of a line whose writer was killed: nothing follows from it.
        with contextlib.suppress(ValueError, LookupError, TypeError):
            self._take_event(json_object(line))

    def _take_event(self, values: Mapping[str, Any]) -> None:
        if values.get("closed") is True:
            self.is_closed = True
        elif "begin" in values:
            name = base_name(values["begin"])
            if infix_of_recording(name) != infix_of(self.path.name):
                raise ValueError(f"{name!r:.100} is no recording of its monitor")
            without = values.get("without", ())
            common = {k: v for k, v in self.facts.items() if k not in without}
            facts = {**common, **mapping(values["facts"])}
            row, look = _count(values["row"]), _count(values["look"])
            # In the order of their rows, also where one is begun anew.
            self.recordings.pop(name, None)
            self.recordings[name] = Recording(name, self, facts, row, look)
        elif "drop" in values:
            self.recordings[values["drop"]].is_dropped = True
        elif "end" in values:
            recording = self.recordings[values["end"]]
            recording.stop = _count(values["row"])
            recording.facts.update(mapping(values["facts"]))
        elif "note" in values:
            self.recordings[values["note"]].facts.update(mapping(values["facts"]))


def create_list(path: Path, first_line: Mapping[str, Any]) -> int:
    """Make a list, and return a descriptor for `append_line`.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone; nothing is left.
    """
    try:
        descriptor = open_for_appending(path, new=True)
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error) from error
    try:
        append_line(path, first_line, descriptor=descriptor)
    except BaseException:
        os.close(descriptor)
        with contextlib.suppress(OSError):
            path.unlink()
        raise
    return descriptor


def append_line(
    path: Path, values: Mapping[str, Any], *, descriptor: int | None = None
) -> None:
    """Add a line to a list, whole or not at all.

    Args:
        path: of the list.
        values: of the line.
        descriptor: of the list, where it is open.

    Raises:
        FileNotWritten: the disk is full, and the list says what it said before; or the
            list was removed.
    """
    line = dumps(values).encode() + b"\n"
    own = None
    try:
        if descriptor is None:
            # It is there: its recordings are named in it.
            path.lstat()
            descriptor = own = open_for_appending(path)
        # The torn end says nothing, also where nothing but its end is missing.
        append_whole(descriptor, line, torn=b"?\n")
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error) from error
    finally:
        if own is not None:
            os.close(own)


def infix_of_recording(name: str) -> str | None:
    """Return the infix in a recording's name; None where it is none."""
    if ClipPart.parse(name) is not None:
        return infix_of(name)
    path = f"{name}{FINISHED}"
    return None if episode_of(path) is None else infix_of(path)


def list_paths(directory: Path, infix: Infix | str | None = None) -> Iterator[Path]:
    """Return the paths of the lists of a directory, or of one monitor in it."""
    names = (name for name in names_in(directory) if name.endswith(SPANS))
    for name in sorted(names):
        own = infix_of(name)
        if own is not None and (infix is None or own == str(infix)):
            yield directory / name


def read_list(path: Path) -> SpanList:
    """Return a list as it is now.

    Raises:
        UnreadableFile: it is no such list, or of a newer format, or there is no such
            file.
    """
    with unreadable(path):
        status = regular_path(path).stat()
        version = status.st_ino, status.st_size, status.st_mtime_ns
        return _read_version(path, version)


# Each recording is looked for by itself, in all lists of its monitor.
@functools.lru_cache(maxsize=64)
def _read_version(path: Path, version: tuple[int, ...]) -> SpanList:
    del version
    spans = SpanList(path)
    with open_regular(path) as file:
        for line in file:
            # Without its end it is being written, or its writer was killed.
            if line.endswith(b"\n"):
                spans._take(line)
    return spans


def find_recording(path: Path) -> Recording | None:
    """Return a recording that is not dropped, by the path of its file; None where none.

    Raises:
        UnreadableFile: no list has it, and one of its monitor's cannot be read.
    """
    name = path.name.removesuffix(FINISHED)
    infix = infix_of_recording(name)
    if infix is None or not path.parent.is_dir():
        return None
    found, damage = None, None
    for each in list_paths(path.parent, infix):
        try:
            recording = read_list(each).recordings.get(name)
        except UnreadableFile as error:
            # A list that was removed just now had nothing in flight.
            damage = error if os.path.lexists(each) else damage
            continue
        if recording is not None and not recording.is_dropped:
            found = recording
    if found is None and damage is not None:
        raise damage
    return found


def get_recording(path: Path) -> Recording:
    """Return a recording that is not dropped, by the path of its file.

    Raises:
        UnreadableFile: there is none, or a list cannot be read.
    """
    recording = find_recording(path)
    if recording is None:
        raise UnreadableFile(path, "there is no such file, and no log of it")
    return recording


def is_in_flight(path: Path) -> bool:
    """Tell whether a recording is in a log only, by the path of its file.

    Raises:
        UnreadableFile: as `find_recording`.
    """
    if path.suffix == FINISHED and is_finished(path):
        return False
    return find_recording(path) is not None


def recordings_in_flight(
    directory: Path, infix: Infix | str | None = None
) -> list[Recording]:
    """Return the recordings that only logs have, of all monitors or one.

    Lists that cannot be read are left out: `read_list` says why.
    """
    found: list[Recording] = []
    for path in list_paths(directory, infix):
        with contextlib.suppress(UnreadableFile):
            found += read_list(path).in_flight()
    return found


def drop_recording(path: Path) -> None:
    """Give up the rows of a recording; it is no error where there are none.

    Raises:
        FileNotWritten: the disk is full.
        DirectoryNotWritable: files cannot be removed.
    """
    recording = find_recording(path)
    if recording is not None:
        append_line(recording.spans.path, {"drop": recording.name})
        remove_if_done(recording.spans.path)


def remove_if_done(path: Path) -> None:
    """Remove a list and its logs once the log is closed and nothing is in flight.

    Raises:
        DirectoryNotWritable: they cannot be removed.
    """
    # Asked first: a monitor that is closed begins nothing any more.
    is_open = _is_open(path)
    try:
        spans = read_list(path)
    except UnreadableFile:
        return
    is_over = spans.is_closed or not is_open
    if is_over and not spans.in_flight() and not spans.is_headless:
        remove_list(path)


def remove_list(path: Path) -> None:
    """Remove a list and its logs.

    Raises:
        DirectoryNotWritable: they cannot be removed.
    """
    log = path.with_suffix(LOG)
    try:
        # The log first, so that no reader opens it without the rest; the list last,
        # because the others are found through it.
        for each in (log, tail_path(log), path.with_suffix(LOOKS), path):
            each.unlink(missing_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(path.parent, error) from error


def _is_open(path: Path) -> bool:
    infix = Infix.parse(infix_of(path.name) or "")
    try:
        return infix is not None and is_locked(path.parent / lock_name(infix))
    except OSError:
        # Unknown: leave its files alone.
        return True


def _count(value: Any) -> int:
    number = integer(value)
    if number < 0:
        raise ValueError(f"{number} is no number of things")
    return number

# SPDX-License-Identifier: Apache-2.0
"""Which rows of a monitor's logs are which recording.

A recording in flight is a span of rows: an episode, or a clip's part that is of one
episode. `openaigym.states.<infix>.<number>.spans` lists those of one row log, a line of
JSON each time something happens::

    {"format": "mjrec spans", "version": 1, "rows": {...}, "facts": {...}}
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
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as attribute
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileNotWritten
from ..json_text import dumps
from .json_fields import (
    base_name,
    field,
    integer,
    json_object,
    list_of,
    mapping,
    text,
)
from .monitor_directory import (
    ClipPart,
    episode_of,
    infix_of,
)
from .regular_files import open_regular
from .trajectory import (
    FORMAT_VERSION,
    TrajectoryHeader,
    check_version,
    header_from_json,
    layout_to_json,
)

FORMAT = "mjrec spans"
SPANS, LOG, LOOKS, FINISHED = ".spans", ".log", ".looks", ".h5"

# In the flags of a row.
TERMINATED, TRUNCATED, STEP, FRAME = 1, 2, 4, 8
# Words before the state: the row's number, the step, the reward, the flags.
HEAD_WORDS = 4

_LONGEST_LINE = 1 << 26


def row_dtype(header: TrajectoryHeader) -> np.dtype[Any]:
    """Return what a row of a log holds; `snapshot` as bytes, packed as the layout says.

    `row` is its own number, `step` counts from the recording's reset, and `flags` tell
    whether it is a step's, a frame's, or both.
    """
    members: list[tuple[str, str, tuple[int, ...]]] = [
        *(("row", "<i8", ()), ("step", "<i8", ())),
        *(("reward", "<f8", ()), ("flags", "<u8", ())),
        ("state", "<f8", (header.state_length,)),
        ("snapshot", "|u1", (header.snapshot.size,)),
    ]
    for name, kind in (("action", header.action), ("observation", header.observation)):
        if kind is not None:
            members.append((name, kind.dtype, kind.shape))
    offsets, offset = [], 0
    for _, dtype, shape in members:
        offsets.append(offset)
        size = np.dtype(dtype).itemsize * int(np.prod(shape, dtype=int))
        offset += -(-size // 8) * 8
    names, formats = [m[0] for m in members], [m[1:] for m in members]
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": offset}
    )


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
            self.path.suffix == FINISHED and self.path.is_file()
        )


@dataclass
class SpanList:
    """A list of spans, as far as it was read.

    Attributes:
        path: of the list.
        header: what its rows look like, and the facts of every recording.
        recordings: by their names.
        is_closed: no row is added any more.
    """

    path: Path
    header: TrajectoryHeader | None = None
    recordings: dict[str, Recording] = attribute(default_factory=dict)
    is_closed: bool = False
    _first: bytes = b""
    _offset: int = 0
    # Size and time of change when it was read.
    _seen: tuple[int, int] = (0, 0)

    @property
    def log(self) -> Path:
        """Its row log."""
        return self.path.with_suffix(LOG)

    @property
    def looks(self) -> Path:
        """The changes of the model."""
        return self.path.with_suffix(LOOKS)

    @property
    def is_headless(self) -> bool:
        """Whether rows are there, and nothing says what they are."""
        rows = self.log.stat().st_size if self.log.exists() else 0
        return self.header is None and rows > 0

    def in_flight(self) -> list[Recording]:
        """Return the recordings that only the log has."""
        return [each for each in list(self.recordings.values()) if each.is_in_flight]

    def read_on(self, status: os.stat_result) -> bool:
        """Read what was added since; tell whether it is the same list still.

        Args:
            status: the file's, before.

        Raises:
            OSError: there is no such file.
            ValueError: it is no such list, or of a newer format.
        """
        seen = status.st_size, status.st_mtime_ns
        if seen == self._seen:
            return True
        with open_regular(self.path) as file:
            # Names and inodes are given anew, where `force` removes what there was.
            is_longer = status.st_size > self._offset or not self._first
            if not is_longer or file.read(len(self._first)) != self._first:
                return False
            file.seek(self._offset)
            while line := file.readline(
                min(_LONGEST_LINE, status.st_size - self._offset)
            ):
                if not line.endswith(b"\n"):
                    # It is being written, or its writer was killed.
                    break
                # In this order: what an error or Ctrl-C cuts short is taken again.
                self._take(line)
                self._first = self._first or line
                self._offset += len(line)
        self._seen = seen
        return True

    def _take(self, line: bytes) -> None:
        if self.header is None:
            values = json_object(line)
            if values.get("format") != FORMAT:
                raise ValueError("it is no list of spans")
            check_version(field(values, "version", integer))
            facts, rows = (
                field(values, "facts", mapping),
                field(values, "rows", mapping),
            )
            self.header = header_from_json(facts, rows)
            return
        try:
            values = json_object(line)
            self._take_event(self.header.facts, values)
        except ValueError:
            # The end of a line whose writer was killed: nothing follows from it.
            return

    def _take_event(self, common: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        if values.get("closed") is True:
            self.is_closed = True
        elif "begin" in values:
            without = list_of(text)(values.get("without") or [])
            facts = {k: v for k, v in common.items() if k not in without}
            name = field(values, "begin", self._name)
            # In the order of their rows, also where one is begun anew.
            self.recordings.pop(name, None)
            self.recordings[name] = Recording(
                name,
                self,
                {**facts, **field(values, "facts", mapping)},
                row=field(values, "row", _count),
                look=field(values, "look", _count),
            )
        elif "drop" in values:
            self._named(values, "drop").is_dropped = True
        elif "end" in values:
            ended = self._named(values, "end")
            ended.stop = field(values, "row", _count)
            ended.facts.update(field(values, "facts", mapping))
        elif "note" in values:
            self._named(values, "note").facts.update(field(values, "facts", mapping))

    def _name(self, value: Any) -> str:
        """Return the name of a recording of this monitor."""
        name = base_name(f"{text(value)}{FINISHED}").removesuffix(FINISHED)
        is_ours = infix_of_recording(name) == infix_of(self.path.name)
        if not is_ours:
            raise ValueError(f"{name!r:.100} is no recording of its monitor")
        return name

    def _named(self, values: Mapping[str, Any], key: str) -> Recording:
        name = field(values, key, text)
        if name not in self.recordings:
            raise ValueError(f"it has no recording {name!r:.100}")
        return self.recordings[name]


def first_line(header: TrajectoryHeader) -> dict[str, Any]:
    """Return what a list of spans begins with."""
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "rows": layout_to_json(header),
        "facts": dict(header.facts),
    }


def append_line(
    path: Path, values: Mapping[str, Any], *, is_first: bool = False
) -> None:
    """Add a line to a list, whole or not at all.

    Raises:
        FileNotWritten: the disk is full, and the list says what it said before; or
            the line is longer than any that is read.
    """
    try:
        flags = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW
        flags |= os.O_CREAT | os.O_EXCL if is_first else 0
        descriptor = os.open(path, flags, 0o666)
        try:
            size = os.fstat(descriptor).st_size
            torn = size and os.pread(descriptor, 1, size - 1) != b"\n"
            line = dumps(dict(values)).encode() + b"\n"
            if torn:
                # So that it says nothing, also where nothing but its end is missing.
                line = b"?\n" + line
            if len(line) > _LONGEST_LINE:
                raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
            written = os.write(descriptor, line)
            if written != len(line):
                _take_back(descriptor, written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            os.close(descriptor)
    except OSError as error:
        if is_first and not isinstance(error, FileExistsError):
            with contextlib.suppress(OSError):
                path.unlink()
        raise FileNotWritten(path, error.strerror or error) from error


def _take_back(descriptor: int, written: int) -> None:
    """Cut off half a line; where another one follows, it stays and is passed over."""
    end = os.lseek(descriptor, 0, os.SEEK_CUR)
    if os.fstat(descriptor).st_size == end:
        os.ftruncate(descriptor, end - written)


def infix_of_recording(name: str) -> str | None:
    """Return the infix in a recording's name; None where it is none."""
    is_part = ClipPart.parse(name) is not None
    is_known = is_part or episode_of(f"{name}{FINISHED}") is not None
    return infix_of(name if is_part else f"{name}{FINISHED}") if is_known else None


def _count(value: Any) -> int:
    number = integer(value)
    if number < 0:
        raise ValueError(f"{number} is no number of things")
    return number

# SPDX-License-Identifier: Apache-2.0
"""The journal: what happened in a run, one line of JSON for each event.

`openaigym.episodes.<infix>.jsonl` grows while the monitor runs, so that a killed
process loses nothing that was over. Statistics and manifest follow from it. A completed
episode is a line::

    {"episode_id": 27, "length": 200, "reward": 12.5, "type": "t",
     "start_time": 1790000000.0, "end_time": 1790000004.0,
     "seed": 7, "options": null, "terminated": false, "truncated": true,
     "success": null, "chosen": true, "recording": "deferred"}

`chosen` is there where the schedule chose the episode, `recording` (`"live"` or
`"deferred"`) where it has a video of its own. Every other line is an event, an object
of one key: its kind, one of `EVENTS`. The first line is the `run`'s.

Times are seconds since the epoch. Keys that this version does not know are ignored.

A killed machine can leave half a line at the end, and a failing disk anything
anywhere. A reader leaves out what is no event, keeps the rest, and says so.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import ClosedError
from ..json_text import dumps
from .json_fields import (
    boolean,
    field,
    integer,
    json_object,
    mapping,
    number,
    optional,
    text,
    unreadable,
)
from .regular_files import open_regular

logger = logging.getLogger(__name__)

# Bounds, so that no file can fill the memory or keep a reader busy for ever. They are
# far beyond what any run writes.
_LONGEST_LINE = 1 << 24
_MOST_DAMAGED_LINES = 1000
_MOST_DAMAGED_BYTES = 1 << 26
MOST_EPISODES = 10**15

# In their order: what the run is; its machine, packages and code; an episode that is
# no part of the statistics; a clip that is over; an episode whose video falls out while
# its trajectory stays; what could not be recorded; which videos were kept; the end; and
# that another process has put the directory in order.
EVENTS = (
    *("run", "surroundings", "cut", "clip", "dropped"),
    *("fault", "keep", "closed", "recovered"),
)

UNKNOWN = "unknown"

# The reason of an episode that ended with its process.
KILLED = "killed"

# The seed and the options are for people to read; more of them is cut off.
_LONGEST_REPR = 1000

_BEGINNING = b'{"episode_id": '
_BEGIN = re.compile(rb'\{"episode_id": (\d{1,15}),')


@dataclass(frozen=True)
class JournalEntry:
    """One completed episode.

    Attributes:
        episode_id: counts the begun episodes of the run.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall clock just before the reset.
        end_time: wall clock after the last step.
        seed: as given to `reset`.
        options: as given to `reset`.
        terminated: the task ended the episode.
        truncated: a limit from outside the task ended it.
        success: what the environment said of it; None where it said nothing, `UNKNOWN`
            in journals of before it was written down.
        chosen: the schedule chose it.
        recording: `"live"` or `"deferred"`; None where it has no video of its own.
    """

    episode_id: int
    length: int
    reward: float
    type: str
    start_time: float
    end_time: float
    seed: Any
    options: Any
    terminated: bool
    truncated: bool
    success: bool | str | None = UNKNOWN
    chosen: bool = False
    recording: str | None = None


class JournalWriter:
    """Appends episodes and other events to a journal.

    The file is made by the first of them. Each is one `write` of whole lines, so that
    a reader at any moment, and a process killed at any moment, has whole lines.

    Args:
        path: the file.
        run: what the first line of a new file says.
    """

    def __init__(self, path: Path, *, run: Mapping[str, Any] | None = None) -> None:
        self._path = path
        self._run = run
        self._file: io.FileIO | None = None
        # Of the whole lines; beyond it is what a failed write has left.
        self._size = 0
        self._closed = False

    def append(self, entry: JournalEntry) -> None:
        """Write down a completed episode.

        A seed or options that would make a line of more than 16 MiB are written as
        `{"repr": ...}` and cut off.

        Raises:
            ClosedError: after `close`.
            OSError: it cannot be written (a full disk); the journal is then as it
                was before. Or it was removed.
        """
        # Not `asdict`, which would copy the options deeply; they may not allow it.
        values = {**vars(entry)}
        if entry.success == UNKNOWN:
            del values["success"]
        for key in ("chosen", "recording"):
            if not values[key]:
                del values[key]
        self._append(_line(values))

    def note(self, kind: str, facts: Any) -> None:
        """Write down another event.

        Args:
            kind: one of `EVENTS`.
            facts: what JSON can hold.

        Raises:
            ClosedError, OSError: as `append`.
        """
        self._append(f"{dumps({kind: facts})}\n".encode())

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._closed = True
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _append(self, line: bytes) -> None:
        if self._closed:
            raise ClosedError(f"The journal {self._path} is closed.")
        if self._file is None:
            self._file = io.FileIO(self._path, "a+")
            self._size = self._file.seek(0, os.SEEK_END)
            if self._size and os.pread(self._file.fileno(), 1, self._size - 1) != b"\n":
                # Its writer was killed in the middle of a line.
                line = b"\n" + line
        if self._size == 0 and self._run is not None:
            line = f"{dumps({'run': self._run})}\n".encode() + line
        self._write(self._file, line)

    def _write(self, file: io.FileIO, line: bytes) -> None:
        status = os.fstat(file.fileno())
        if status.st_nlink == 0:
            # What is written there is nowhere. The next entry begins another file.
            file.close()
            self._file = None
            raise OSError(
                errno.ENOENT, "it was removed while it was written", str(self._path)
            )
        if status.st_size > self._size:
            # Half a line would damage the one after it. Taking it back had failed, or
            # was interrupted.
            os.ftruncate(file.fileno(), self._size)
        # Unbuffered: the line is with the operating system when `write` returns.
        if file.write(line) != len(line):
            os.ftruncate(file.fileno(), self._size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
        self._size += len(line)


def _line(values: dict[str, Any]) -> bytes:
    line = f"{dumps(values)}\n".encode()
    if len(line) < _LONGEST_LINE:
        return line
    for key in ("seed", "options"):
        values[key] = {"repr": repr(values[key])[:_LONGEST_REPR]}
    return f"{dumps(values)}\n".encode()


class JournalReader:
    """Reads the entries of a journal, one at a time, in the order written.

    Iterate over it, once. Lines that are no episode are left out and counted, and so
    is an episode whose number was there before. After a line of 16 MiB or more, or
    when too much is damaged for a journal, everything that follows is left out.

    Args:
        path: the file.
        on_event: called with the kind and the facts of every other event.

    Attributes:
        count: how many entries there were so far.
        last_episode_id: the highest number so far, also of damaged lines that still
            show theirs; -1 before.
        dropped: how many lines were left out so far.
    """

    def __init__(
        self, path: Path, *, on_event: Callable[[str, Any], object] = lambda *_: None
    ) -> None:
        self._path = path
        self._on_event = on_event
        self._numbers = _Numbers()
        self._damaged_lines = 0
        self._damaged_bytes = 0
        self._first_reason = ""
        self._gave_up = False
        self.count = 0
        self.last_episode_id = -1
        self.dropped = 0

    def __iter__(self) -> Iterator[JournalEntry]:
        """Yield the entries.

        Raises:
            UnreadableFile: there is no such file, or it cannot be read.
        """
        with _opened(self._path) as file:
            for index, line in enumerate(_lines(self._path, file), start=1):
                entry = self._entry(index, line)
                if entry is not None:
                    yield entry
                if self._gave_up:
                    return

    def report(self) -> None:
        """Say in the log what was left out, if anything was."""
        if not self.dropped:
            return
        rest = " and all that follows" if self._gave_up else ""
        logger.warning(
            "%s: %d %s%s left out: %s%s.",
            self._path,
            self.dropped,
            "line" if self.dropped == 1 else "lines",
            rest,
            "" if self.dropped == 1 else "first ",
            self._first_reason,
        )

    def _entry(self, index: int, line: bytes) -> JournalEntry | None:
        try:
            if len(line) >= _LONGEST_LINE:
                self._gave_up = True
                raise ValueError("it is too long to be an episode's")
            values = json_object(line)
            kind = next(iter(values)) if len(values) == 1 else None
            if kind in EVENTS:
                self._on_event(kind, values[kind])
                return None
            entry = entry_of(values)
        except ValueError as error:
            torn = not line.endswith(b"\n") and not self._gave_up
            # Its writer was killed in the middle of it, or is at it now.
            self._note(index, line, "it was cut off" if torn else str(error))
            self._count_damage(line)
            return None
        if not self._numbers.add(entry.episode_id):
            self._note(index, line, "its episode was there before")
            return None
        self.count += 1
        self.last_episode_id = max(self.last_episode_id, entry.episode_id)
        return entry

    def _note(self, index: int, line: bytes, reason: str) -> None:
        """Note a line that is left out."""
        begin = _BEGIN.match(line)
        if begin is not None:
            self.last_episode_id = max(self.last_episode_id, int(begin[1]))
        if not self.dropped:
            episode = f" (episode {int(begin[1])})" if begin else ""
            self._first_reason = f"line {index}{episode}: {reason}"
        self.dropped += 1

    def _count_damage(self, line: bytes) -> None:
        self._damaged_lines += 1
        self._damaged_bytes += len(line)
        self._gave_up = self._gave_up or (
            self._damaged_lines >= _MOST_DAMAGED_LINES
            or self._damaged_bytes >= _MOST_DAMAGED_BYTES
        )


class _Numbers:
    """A set of episode numbers that takes little memory where they are dense."""

    _BLOCK = 4096

    def __init__(self) -> None:
        self._blocks: dict[int, int] = {}

    def add(self, number: int) -> bool:
        """Add `number`; False where it was there before."""
        block, bit = divmod(number, self._BLOCK)
        old = self._blocks.get(block, 0)
        self._blocks[block] = old | 1 << bit
        return not old >> bit & 1


def read_journal(path: Path) -> Iterator[JournalEntry]:
    """Yield the entries of a journal, one at a time, in the order written.

    What is no episode is left out, as by `JournalReader`, with one warning at the end.

    Raises:
        UnreadableFile: there is no such file, or it cannot be read.
    """
    reader = JournalReader(path)
    try:
        yield from reader
    finally:
        reader.report()


def run_facts(path: Path) -> Mapping[str, Any] | None:
    """Return what the first line of a journal says of its run; None where nothing.

    Raises:
        UnreadableFile: there is no such file, or it cannot be read.
    """
    with _opened(path) as file:
        line = next(_lines(path, file), b"")
    try:
        return field(json_object(line), "run", optional(mapping), default=None)
    except ValueError:
        return None


def count_lines(path: Path) -> int:
    """Return how many lines of a journal begin as an episode's: at least all of those.

    It takes a fraction of the time of reading them.

    Raises:
        UnreadableFile: there is no such file, or it cannot be read.
    """
    with _opened(path) as file:
        count = 0
        for line in _lines(path, file):
            count += line.startswith(_BEGINNING)
            if len(line) >= _LONGEST_LINE:
                break
        return count


def _opened(path: Path) -> BinaryIO:
    with unreadable(path):
        return open_regular(path)


def _lines(path: Path, file: BinaryIO) -> Iterator[bytes]:
    while True:
        # Disks fail while they are read, too.
        with unreadable(path):
            line = file.readline(_LONGEST_LINE)
        if not line:
            return
        yield line


def entry_of(values: Mapping[str, Any]) -> JournalEntry:
    """Return the entry whose members a line of a journal, or a trajectory, has.

    Raises:
        ValueError: one is missing, or is not what it should be.
    """
    return JournalEntry(
        episode_id=field(values, "episode_id", _count),
        length=field(values, "length", _count),
        reward=field(values, "reward", number),
        type=field(values, "type", text),
        start_time=field(values, "start_time", number),
        end_time=field(values, "end_time", number),
        seed=values.get("seed"),
        options=values.get("options"),
        terminated=field(values, "terminated", boolean),
        truncated=field(values, "truncated", boolean),
        success=_success(values),
        chosen=field(values, "chosen", boolean, default=False),
        recording=field(values, "recording", optional(text), default=None),
    )


def _success(values: Mapping[str, Any]) -> bool | str | None:
    if "success" not in values:
        return UNKNOWN
    return field(values, "success", optional(boolean))


def _count(value: Any) -> int:
    count = integer(value)
    if not 0 <= count < MOST_EPISODES:
        # Not its digits, of which there may be thousands.
        raise ValueError("it is negative, or larger than any count can be")
    return count

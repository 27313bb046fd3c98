# SPDX-License-Identifier: Apache-2.0
"""The journal: one line of JSON for each completed episode, as it completes.

`openaigym.episodes.<infix>.jsonl` grows while the monitor runs, so that a killed
process loses none of the episodes that it completed. A line::

    {"episode_id": 27, "length": 200, "reward": 12.5, "type": "t",
     "start_time": 1790000000.0, "end_time": 1790000004.0,
     "seed": 7, "options": null, "terminated": false, "truncated": true,
     "success": null}

The first line says besides what is recorded, as a manifest does::

     "env_info": {"gym_version": "mjrec-1", "env_id": "Hopper-v5"}

Times are seconds since the epoch. Keys that this version does not know are ignored.

A killed machine can leave half a line at the end, and a failing disk anything
anywhere. A reader leaves out what is no episode, keeps the rest, and says so.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import re
from collections.abc import Iterator, Mapping
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

UNKNOWN = "unknown"

# The seed and the options are for people to read; more of them is cut off.
_LONGEST_REPR = 1000

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


class JournalWriter:
    """Appends entries to a journal.

    The file is made by the first `append`: a monitor that completes no episode
    leaves no journal. Each entry is one `write` of one whole line, so that a reader
    at any moment, and a process killed at any moment, has whole lines.

    Args:
        path: the file.
        env_info: what is recorded, `gym_version` and `env_id`, for readers of a
            journal whose monitor left no manifest.
    """

    def __init__(
        self, path: Path, *, env_info: Mapping[str, Any] | None = None
    ) -> None:
        self._path = path
        self._env_info = env_info
        self._file: io.FileIO | None = None
        # Of the whole lines; beyond it is what a failed write has left.
        self._size = 0
        self._closed = False

    def append(self, entry: JournalEntry) -> None:
        """Write `entry` down.

        A seed or options that would make a line of more than 16 MiB are written as
        `{"repr": ...}` and cut off.

        Raises:
            ClosedError: after `close`.
            OSError: it cannot be written (a full disk); the journal is then as it
                was before. Or somebody has removed it.
        """
        if self._closed:
            raise ClosedError(f"The journal {self._path} is closed.")
        if self._file is None:
            self._file = io.FileIO(self._path, "a")
            self._size = os.fstat(self._file.fileno()).st_size
        # Not `asdict`, which would copy the options deeply; they may not allow it.
        values = {**vars(entry)}
        if entry.success == UNKNOWN:
            del values["success"]
        if self._env_info is not None:
            values["env_info"] = dict(self._env_info)
        self._write(self._file, _line(values))
        self._env_info = None

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._closed = True
        file, self._file = self._file, None
        if file is not None:
            file.close()

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

    Attributes:
        count: how many entries there were so far.
        last_episode_id: the highest number so far, also of damaged lines that still
            show theirs; -1 before.
        env_info: what is recorded, as far as the lines so far say it.
        dropped: how many lines were left out so far.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._numbers = _Numbers()
        self._damaged_lines = 0
        self._damaged_bytes = 0
        self._first_reason = ""
        self._gave_up = False
        self.count = 0
        self.last_episode_id = -1
        self.env_info: Mapping[str, Any] | None = None
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
        if self.env_info is None:
            self.env_info = _env_info(values)
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


def count_lines(path: Path) -> int:
    """Return how many lines a journal has: at least as many as it has episodes.

    It takes a fraction of the time of reading them.

    Raises:
        UnreadableFile: there is no such file, or it cannot be read.
    """
    with _opened(path) as file:
        count = 0
        for line in _lines(path, file):
            count += 1
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


def _env_info(values: Mapping[str, Any]) -> Mapping[str, Any] | None:
    try:
        return field(values, "env_info", optional(mapping), default=None)
    except ValueError:
        # Its episode is as good as any.
        return None

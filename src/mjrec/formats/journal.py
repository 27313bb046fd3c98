# SPDX-License-Identifier: Apache-2.0
"""The journal: one line of JSON for each completed episode, as it completes.

`openaigym.episodes.<infix>.jsonl` grows while the monitor runs, so that a killed
process loses none of the episodes that it completed. A line::

    {"episode_id": 27, "length": 200, "reward": 12.5, "type": "t",
     "start_time": 1790000000.0, "end_time": 1790000004.0,
     "seed": 7, "options": null, "terminated": false, "truncated": true}

Times are seconds since the epoch. Keys that this version does not know are ignored.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ClosedError, UnreadableFile
from ..json_text import dumps
from .json_fields import boolean, field, integer, json_object, number, text, unreadable

__all__ = ["JournalEntry", "JournalWriter", "read_journal"]

logger = logging.getLogger(__name__)

# Far beyond any episode's options; a bound, so that no file can fill the memory.
_LONGEST_LINE = 1 << 24


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


class JournalWriter:
    """Appends entries to a journal.

    The file is made by the first `append`: a monitor that completes no episode
    leaves no journal. Each entry is one `write` of one whole line, so that a reader
    at any moment, and a process killed at any moment, has whole lines.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: io.FileIO | None = None
        self._closed = False

    def append(self, entry: JournalEntry) -> None:
        """Write `entry` down.

        Raises:
            ClosedError: after `close`.
            OSError: it cannot be written (a full disk); the journal is then as it
                was before.
        """
        if self._closed:
            raise ClosedError(f"The journal {self._path} is closed.")
        if self._file is None:
            self._file = io.FileIO(self._path, "a")
        # Not `asdict`, which would copy the options deeply; they may not allow it.
        values = {f.name: getattr(entry, f.name) for f in dataclasses.fields(entry)}
        self._write(self._file, f"{dumps(values)}\n".encode())

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._closed = True
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _write(self, file: io.FileIO, line: bytes) -> None:
        # Unbuffered: the line is with the operating system when `write` returns.
        written = file.write(line)
        if written != len(line):
            # Half a line would damage the one after it.
            size = os.fstat(file.fileno()).st_size
            os.ftruncate(file.fileno(), size - (written or 0))
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))


def read_journal(path: Path) -> Iterator[JournalEntry]:
    """Yield the entries of a journal, one at a time, in the order written.

    A last line without its end, which a killed machine can leave, is skipped with a
    warning.

    Raises:
        UnreadableFile: there is no such file, or a line in it is damaged.
    """
    with unreadable(path):
        if path.exists() and not path.is_file():
            raise ValueError("it is not a regular file")
        file = path.open("rb")
    with file:
        for index, line in enumerate(_lines(path, file), start=1):
            try:
                entry = _parse(line)
            except ValueError as error:
                if not line.endswith(b"\n"):
                    logger.warning("%s: line %d was cut off; left out.", path, index)
                    return
                raise UnreadableFile(path, f"line {index}: {error}") from error
            yield entry


def _lines(path: Path, file: io.BufferedReader) -> Iterator[bytes]:
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE and not line.endswith(b"\n"):
            raise UnreadableFile(path, "a line is too long to be an episode's")
        yield line


def _parse(line: bytes) -> JournalEntry:
    values = json_object(line)
    return JournalEntry(
        episode_id=field(values, "episode_id", integer),
        length=field(values, "length", integer),
        reward=field(values, "reward", number),
        type=field(values, "type", text),
        start_time=field(values, "start_time", number),
        end_time=field(values, "end_time", number),
        seed=values.get("seed"),
        options=values.get("options"),
        terminated=field(values, "terminated", boolean),
        truncated=field(values, "truncated", boolean),
    )

# SPDX-License-Identifier: Apache-2.0
"""The journal: the events of a run, with one line of JSON for each event.

`openaigym.episodes.<infix>.jsonl` grows while the monitor runs, so that no completed
episode is lost if the process is killed. The statistics and the manifest are derived
from it. It also records which rows in the logs belong to which recording (see `spans`).
Each completed episode has one line::

    {"episode_id": 27, "length": 200, "reward": 12.5, "type": "t",
     "start_time": 1790000000.0, "end_time": 1790000004.0,
     "seed": 7, "options": null, "terminated": false, "truncated": true,
     "success": null, "chosen": true, "recording": "deferred"}

`chosen` is present if the schedule chose the episode, `recording` (`"live"` or
`"deferred"`) if the episode has a video of its own, and `evaluation` (seed, number and
MuJoCo's warnings) if it is part of an evaluation. Every other line is an object with a
single key, which is the kind of event: one of `EVENTS` or `SPAN_EVENTS`. The first line
is the `run` event.

Times are seconds since the epoch. Keys that this version does not know are ignored.

If the machine crashes, the last line may be incomplete, and a failing disk can corrupt
any line. A reader skips and reports invalid lines, and keeps the rest.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from ..atomic_files import append_whole, open_for_appending, writing
from ..errors import ClosedError
from ..json_text import dumps
from .json_fields import from_json, integer, json_object, unreadable
from .regular_files import open_regular

logger = logging.getLogger(__name__)

# Limits, so that no file can fill the memory or keep a reader busy forever. No run
# comes anywhere near them.
_LONGEST_LINE = 1 << 24
_MOST_DAMAGED_LINES = 1000
_BLOCK = 4096
MOST_EPISODES = 10**15

# In order: the run's facts; its machine, packages and code; an episode that is not part
# of the statistics; a finished clip; an action that does not fit into a row; an episode
# whose video is dropped while its trajectory stays; a failure to record something; the
# videos that were kept; the end of the run; the recovery of the directory by another
# process; the beginning of an episode of an evaluation; the failure of such an episode.
EVENTS = (
    *("run", "provenance", "cut", "clip", "action", "dropped"),
    *("fault", "keep", "closed", "recovered", "begun", "failed"),
)

# Events about recordings, in order: the layout of the rows; the beginning of a
# recording; more facts about it; its end; the loss of its rows; a log that is full.
SPAN_EVENTS = ("rows", "begin", "note", "end", "drop", "full")
_OF_SPANS = tuple(f'{{"{kind}": '.encode() for kind in SPAN_EVENTS)

# Seeds and options are for people to read, so longer values are truncated.
_LONGEST_REPR = 1000

_BEGIN = re.compile(rb'\{"episode_id": (\d{1,15}),')


@dataclass(frozen=True)
class JournalEntry:
    """One completed episode.

    Attributes:
        episode_id: the episode's number, counting every episode that began, from 0.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall-clock time just before the reset.
        end_time: wall-clock time after the last step.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        terminated: whether the task ended the episode.
        truncated: whether a limit outside the task ended the episode.
        success: whether the environment reported success; None if it reported neither
            success nor failure.
        chosen: whether the schedule chose the episode.
        recording: `"live"` or `"deferred"`; None if the episode has no video of its
            own.
        evaluation: `seed`, `episode` and `warnings`, for an episode of an evaluation.
    """

    episode_id: Annotated[int, count]
    length: Annotated[int, count]
    reward: float
    type: str
    start_time: float
    end_time: float
    seed: Any
    options: Any
    terminated: bool
    truncated: bool
    success: bool | None = None
    chosen: bool = False
    recording: str | None = None
    evaluation: Mapping[str, Any] | None = None


class JournalWriter:
    """A writer that appends episodes and other events to a journal.

    The first event creates the file. Each event is a single `write` of whole lines, so
    readers see only whole lines at any time, even after the process is killed. Lines
    that did not fit on a full disk are written before the next line.

    Args:
        path: the file.
        run: the facts of the `run` event, the first line of a new file.

    Attributes:
        path: the file.
        lost: number of times the file was removed. A new file does not repeat the lines
            of the removed file.
    """

    def __init__(self, path: Path, *, run: Mapping[str, Any] | None = None) -> None:
        self.path = path
        self.lost = 0
        self._run = run
        self._descriptor: int | None = None
        self._unwritten = b""
        self._is_empty = self._is_whole = self._closed = False

    def append(self, entry: JournalEntry) -> None:
        """Record a completed episode.

        If the seed or options would make the line 16 MiB or longer, they are written as
        `{"repr": ...}` and truncated.

        Raises:
            ClosedError: the journal is closed.
            FileNotWritten: the journal was removed, or cannot be written now and is
                unchanged (for example, because the disk is full).
        """
        # `asdict` would deep-copy the options, which may not support that.
        optional_keys = ("chosen", "recording", "evaluation")
        left_out = [key for key in optional_keys if not vars(entry)[key]]
        values = {k: v for k, v in vars(entry).items() if k not in left_out}
        line = dumps(values)
        if len(line) >= _LONGEST_LINE:
            line = dumps(_shortened(values))
        self._append(f"{line}\n".encode())

    def note(self, kind: str, facts: Any, *, later: bool = True) -> None:
        """Record another event.

        Args:
            kind: one of `EVENTS` or `SPAN_EVENTS`.
            facts: the event's facts, as any JSON value.
            later: whether to retry with the next line if the event cannot be written
                now.

        Raises:
            ClosedError: the journal is closed.
            FileNotWritten: see `append`.
        """
        line = dumps({kind: facts})
        if len(line) >= _LONGEST_LINE and kind in ("rows", "begin"):
            line = dumps({kind: {**facts, "facts": _shortened(facts["facts"])}})
        self._append(f"{line}\n".encode(), later=later)

    @property
    def is_behind(self) -> bool:
        """Whether some lines have not been written yet."""
        return bool(self._unwritten)

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._closed = True
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _append(self, line: bytes, *, later: bool = True) -> None:
        if self._closed:
            raise ClosedError(f"The journal {self.path} is closed.")
        lines = self._unwritten + line
        if later:
            self._unwritten = lines
        with writing(self.path):
            self._write(lines)
        self._unwritten = b""

    def _write(self, lines: bytes) -> None:
        if self._descriptor is None:
            self._descriptor = open_for_appending(self.path)
            self._is_empty = not os.fstat(self._descriptor).st_size
            self._is_whole = False
        if self._run is not None and self._is_empty:
            lines = f"{dumps({'run': self._run})}\n".encode() + lines
        try:
            # Only an earlier writer or a failure can have left an incomplete line.
            is_whole, self._is_whole = self._is_whole, False
            append_whole(self._descriptor, lines, torn=b"" if is_whole else b"\n")
            self._is_empty, self._is_whole = False, True
        except FileNotFoundError:
            # The next event creates a new file.
            os.close(self._descriptor)
            self._descriptor = None
            self.lost += 1
            raise


def _shortened(values: Mapping[str, Any]) -> dict[str, Any]:
    cut = {
        key: {"repr": repr(values[key])[:_LONGEST_REPR]}
        for key in ("seed", "options")
        if key in values
    }
    return {**values, **cut}


def is_of_spans(line: bytes) -> bool:
    """Return whether a journal line is about rows, which `formats.spans` handles."""
    return line.startswith(_OF_SPANS)


def read_journal(
    path: Path,
    *,
    on_event: Callable[[str, Any], object] = lambda *_: None,
    on_damage: Callable[[int], object] = lambda _: None,
    warns: bool = False,
) -> Iterator[JournalEntry]:
    """Yield a journal's entries in the order in which they were written.

    Invalid lines are skipped, and so are episodes whose number has already occurred.
    After a line of 16 MiB or more, or after too many damaged lines, the rest of the
    file is skipped.

    Args:
        path: the file.
        on_event: called with the kind and the facts of every other event.
        on_damage: called with the episode number of a skipped line, if it is readable.
        warns: whether to log a warning about skipped lines at the end.

    Raises:
        UnreadableFile: the file is missing or cannot be read.
    """
    # The episode numbers so far. They are dense, so each is stored as one bit.
    seen: dict[int, int] = {}
    damaged = skipped = 0
    first_reason = rest = ""
    for index, line in enumerate(_lines(path), 1):
        if is_of_spans(line):
            continue
        try:
            if len(line) >= _LONGEST_LINE:
                raise ValueError("it is too long for an episode")
            values = json_object(line)
            kind = next(iter(values)) if len(values) == 1 else None
            if kind in EVENTS:
                on_event(kind, values[kind])
                continue
            entry = entry_of(values)
        except ValueError as error:
            damaged += 1
            if len(line) >= _LONGEST_LINE or damaged >= _MOST_DAMAGED_LINES:
                rest = " and the rest of the file"
            # Its writer was killed in the middle of the line, or is still writing it.
            is_torn = not line.endswith(b"\n") and not rest
            reason = "it was cut off" if is_torn else str(error)
        else:
            block, bit = divmod(entry.episode_id, _BLOCK)
            if not seen.get(block, 0) >> bit & 1:
                seen[block] = seen.get(block, 0) | 1 << bit
                yield entry
                continue
            reason = "its episode has occurred before"
        skipped += 1
        episode = ""
        if (begin := _BEGIN.match(line)) is not None:
            on_damage(int(begin[1]))
            episode = f" (episode {int(begin[1])})"
        first_reason = first_reason or f"line {index}{episode}: {reason}"
        if rest:
            break
    if warns and skipped:
        lines, first = f"{skipped} lines", "the first is "
        if skipped == 1:
            lines, first = "1 line", ""
        reason = f"skipped {lines}{rest}: {first}{first_reason}"
        logger.warning("%s: %s.", path, reason)


def _lines(path: Path) -> Iterator[bytes]:
    with unreadable(path), open_regular(path) as file:
        yield from iter(lambda: file.readline(_LONGEST_LINE), b"")


def entry_of(values: Mapping[str, Any]) -> JournalEntry:
    """Return the entry in a line of a journal, or in the facts of a trajectory.

    Raises:
        ValueError: a member is missing or has the wrong type.
    """
    return from_json(JournalEntry, {"seed": None, "options": None, **values})


def count(value: Any) -> int:
    """Convert a value from a journal to a number of episodes, steps or rows."""
    number = integer(value)
    if not 0 <= number < MOST_EPISODES:
        # Do not show the value, because it may have thousands of digits.
        raise ValueError("it is negative or too large for a count")
    return number

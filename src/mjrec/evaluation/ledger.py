# SPDX-License-Identifier: Apache-2.0
"""The ledger of a batch: which episode of which monitor is which of an evaluation's.

`mjrec.evaluation.<infix>.jsonl`, beside the files of the batch's first monitor, grows
while the batch runs. Its lines::

    {"ledger": 1, "task": "HalfCheetah-v5"}
    {"batch": [0, 1, 2], "seed": 7, "whole": false}
    {"begun": [7, 0], "monitor": "0.4711", "episode_id": 0}
    {"ended": {"seed": 7, "episode": 0, "total_reward": 12.5, ...}}

Seed and number tell an episode of the evaluation, which may have been begun by several
monitors; `episode_id` is its number in this one. `whole` says that the batch is done as
a whole or not at all: the episodes of one random stream.

A process that is killed between an episode's end, which the journal has first, and the
line about it has lost nothing: the result is made of the journal, which does not know
of MuJoCo's warnings.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import logging
import math
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten, UnreadableFile
from ..formats.journal import MOST_EPISODES, JournalEntry, read_journal
from ..formats.json_fields import (
    boolean,
    integer,
    json_object,
    list_of,
    mapping,
    number,
    optional,
    text,
    unreadable,
)
from ..formats.json_fields import field as field_of
from ..formats.monitor_directory import Infix, journal_name
from ..formats.regular_files import open_regular
from ..json_text import dumps
from .episode_results import EpisodeResult
from .plan import Batch

logger = logging.getLogger(__name__)

Unit = tuple[int, int]

LEDGER_PATTERN = "mjrec.evaluation.*.jsonl"
_VERSION = 1
_THEN = "resuming the evaluation (--resume) goes on from there"
_LONGEST_LINE = 1 << 24
_LONGEST_FAILURE = 2000

# Of a million results nearly all have the same, and few monitors have made them.
_NO_WARNINGS: Mapping[str, int] = {}


def ledger_name(name: str) -> str:
    """Return the base name of a ledger.

    Args:
        name: the infix of the batch's first monitor, or what stands for it.
    """
    return LEDGER_PATTERN.replace("*", name)


class Ledger:
    """Appends to the ledger of a batch. Each line is one `write`, of a whole line.

    Args:
        path: the file, which must not be there.
        batch: what is run.
        whole: whether it is done as a whole or not at all.

    Raises:
        FileNotWritten: it cannot be written.
    """

    def __init__(self, path: Path, batch: Batch, *, whole: bool) -> None:
        self._path = path
        self._size = 0
        try:
            self._file = io.FileIO(path, "xb")
        except OSError as error:
            raise FileNotWritten(path, error.strerror or error, then=_THEN) from error
        self._write({"ledger": _VERSION, "task": batch.task})
        self._write({"batch": list(batch.episodes), "seed": batch.seed, "whole": whole})

    def begin(self, unit: Unit, *, monitor: str, episode_id: int) -> None:
        """Say that an episode begins: before the reset.

        Raises:
            FileNotWritten: the disk is full; the ledger is as before.
        """
        self._write({"begun": list(unit), "monitor": monitor, "episode_id": episode_id})

    def end(self, result: EpisodeResult) -> None:
        """Write down the result of an episode, which is over.

        Raises:
            FileNotWritten: the disk is full; the ledger is as before.
        """
        fields = dataclasses.fields(result)
        values = {each.name: getattr(result, each.name) for each in fields}
        # The first line has it.
        del values["task"]
        if result.failure is not None:
            values["failure"] = result.failure[:_LONGEST_FAILURE]
        self._write({"ended": values})

    def close(self) -> None:
        """Close the file; idempotent."""
        self._file.close()

    def _write(self, values: Mapping[str, Any]) -> None:
        line = f"{dumps(values)}\n".encode()
        try:
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._file.seek(self._size)
            self._file.truncate()
            raise FileNotWritten(
                self._path, error.strerror or error, then=_THEN
            ) from error
        self._size += len(line)


def read_ledgers(folder: Path) -> dict[Unit, EpisodeResult]:
    """Return the results of all episodes of a task that are done.

    Those of a batch that counts as a whole are among them only when all are there, and
    then all from one ledger. Of an episode that was done more than once, the earliest
    counts. Lines that are not whole, and such that nobody knows, are left out.

    Args:
        folder: the task's monitor directory; it may be missing.

    Raises:
        UnreadableFile: a ledger, or a journal that stands in for one, cannot be read.
    """
    done: dict[Unit, EpisodeResult] = {}
    batches = [batch for path in _ledgers(folder) for batch in _batches(path)]
    for batch in sorted(batches, key=lambda batch: batch.begin):
        results = {result.unit: result for result in batch.results}
        if batch.whole and (
            set(results) != batch.units or not done.keys().isdisjoint(results)
        ):
            continue
        for unit, result in results.items():
            done.setdefault(unit, result)
    return done


@dataclass
class _Batch:
    """What a ledger says of a batch.

    Attributes:
        task: the environment's name.
        units: that it was to have.
        whole: whether it is done as a whole or not at all.
        begun: monitor and number in it of those that began and have no result.
        results: of those that ended.
    """

    task: str
    units: set[Unit] = field(default_factory=set)
    whole: bool = False
    begun: dict[Unit, tuple[Infix, int]] = field(default_factory=dict)
    results: list[EpisodeResult] = field(default_factory=list)

    @property
    def begin(self) -> float:
        """When its first episode began that ended."""
        times = (r.start_time for r in self.results if r.start_time is not None)
        return min(times, default=math.inf)


def _ledgers(folder: Path) -> list[Path]:
    return sorted(folder.glob(LEDGER_PATTERN)) if folder.is_dir() else []


def _batches(path: Path) -> list[_Batch]:
    """Return what a ledger says, batch by batch, and what journals say besides."""
    batches: list[_Batch] = []
    task: str | None = None
    for values in _lines(path):
        try:
            if "ledger" in values:
                task = _task(path, values)
            elif task is not None and "batch" in values:
                batches.append(_new_batch(values, task))
            elif batches:
                _note(batches[-1], values)
        except ValueError as error:
            logger.warning("%s: a line is left out: %s.", path, error)
    for batch in batches:
        _complete(batch, path.parent)
    return batches


def _lines(path: Path) -> Iterator[Mapping[str, Any]]:
    with unreadable(path), open_regular(path) as file:
        while line := file.readline(_LONGEST_LINE):
            if not line.endswith(b"\n"):
                # Its writer was killed in the middle of it, or is at it now.
                return
            try:
                yield json_object(line)
            except ValueError as error:
                logger.warning("%s: a line is left out: %s.", path, error)


def _task(path: Path, values: Mapping[str, Any]) -> str:
    version = field_of(values, "ledger", integer)
    if version > _VERSION:
        raise UnreadableFile(
            path, f"it has the version {version}, which a newer mjrec wrote"
        )
    return field_of(values, "task", text)


def _new_batch(values: Mapping[str, Any], task: str) -> _Batch:
    seed = field_of(values, "seed", _count)
    numbers = field_of(values, "batch", list_of(_count))
    return _Batch(
        task,
        units={(seed, each) for each in numbers},
        whole=field_of(values, "whole", boolean),
    )


def _note(batch: _Batch, values: Mapping[str, Any]) -> None:
    if "begun" in values:
        seed, episode = field_of(values, "begun", _pair)
        monitor = field_of(values, "monitor", _infix)
        episode_id = field_of(values, "episode_id", _count)
        batch.begun[seed, episode] = monitor, episode_id
    elif "ended" in values:
        result = _result(field_of(values, "ended", mapping), batch)
        batch.begun.pop(result.unit, None)
        batch.results.append(result)


def _result(values: Mapping[str, Any], batch: _Batch) -> EpisodeResult:
    monitor = field_of(values, "monitor", optional(_infix))
    return EpisodeResult(
        task=batch.task,
        seed=field_of(values, "seed", _count),
        episode=field_of(values, "episode", _count),
        total_reward=_total_reward(values),
        length=field_of(values, "length", _count),
        terminated=field_of(values, "terminated", optional(boolean)),
        truncated=field_of(values, "truncated", optional(boolean)),
        success=field_of(values, "success", optional(boolean), default=None),
        failure=field_of(values, "failure", optional(text), default=None),
        warnings=field_of(values, "warnings", _counts, default={}) or _NO_WARNINGS,
        monitor=None if monitor is None else sys.intern(str(monitor)),
        episode_id=field_of(values, "episode_id", optional(_count)),
        start_time=field_of(values, "start_time", optional(number)),
        seconds=field_of(values, "seconds", optional(number)),
    )


def _total_reward(values: Mapping[str, Any]) -> float | None:
    # NaN is null in JSON, and null is no return where there was a failure.
    if values.get("failure") is not None:
        return None
    return field_of(values, "total_reward", number)


def _count(value: Any) -> int:
    count = integer(value)
    if not 0 <= count < MOST_EPISODES:
        raise ValueError("it is negative, or larger than any count can be")
    return count


def _pair(value: Any) -> tuple[int, int]:
    counts = list_of(_count)(value)
    if len(counts) != 2:
        raise ValueError(f"seed and number are two, not {len(counts)}")
    return counts[0], counts[1]


def _infix(value: Any) -> Infix:
    infix = Infix.parse(text(value))
    if infix is None:
        raise ValueError(f"{value!r:.80} is no monitor's")
    return infix


def _counts(value: Any) -> Mapping[str, int]:
    return {text(name): _count(count) for name, count in mapping(value).items()}


def _complete(batch: _Batch, folder: Path) -> None:
    """Add the results of episodes that journals call complete."""
    by_monitor: dict[Infix, dict[int, Unit]] = {}
    for unit, (infix, episode_id) in batch.begun.items():
        by_monitor.setdefault(infix, {})[episode_id] = unit
    for infix, units in by_monitor.items():
        journal = folder / journal_name(infix)
        for entry in read_journal(journal) if journal.exists() else ():
            if entry.episode_id in units:
                unit = units[entry.episode_id]
                batch.results.append(_of_journal(batch, infix, unit, entry))


def _of_journal(
    batch: _Batch, infix: Infix, unit: Unit, entry: JournalEntry
) -> EpisodeResult:
    return EpisodeResult(
        task=batch.task,
        seed=unit[0],
        episode=unit[1],
        total_reward=entry.reward,
        length=entry.length,
        terminated=entry.terminated,
        truncated=entry.truncated,
        success=entry.success,
        monitor=str(infix),
        episode_id=entry.episode_id,
        start_time=entry.start_time,
        seconds=entry.end_time - entry.start_time,
    )

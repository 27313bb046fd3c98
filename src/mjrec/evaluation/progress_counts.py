# SPDX-License-Identifier: Apache-2.0
"""How many episodes are over, counted from ledgers while they grow.

An evaluation may have ten thousand ledgers, and somebody looks several times a second:
of each only what is new is read, one whose batch is over is not looked at again, and
where looking takes long it is done less often.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..formats.monitor_directory import names_in
from .ledger import LEDGER_PATTERN

# How a line begins that says how an episode ended, and what stands in it where that
# was no failure. Only for a bar: what counts in the end is what `ledger` reads.
_ENDED = b'{"ended"'
_NO_FAILURE = b'"failure": null'
_BATCH = b'{"batch"'

_BEGIN, _, _END = LEDGER_PATTERN.partition("*")

# What takes less may be done at any time; what takes more has a twentieth of the time.
_SHORT_S = 0.02
_REST = 19


@dataclass
class _Read:
    position: int = 0
    asked: int = 0
    done: int = 0
    failed: int = 0

    @property
    def is_over(self) -> bool:
        return 0 < self.asked <= self.done


class LedgerCounts:
    """Counts what ledgers say, reading of each only what is new.

    Args:
        folders: of the tasks.
        clock: tells seconds.
    """

    def __init__(
        self,
        folders: Iterable[Path],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        # By the names of ledgers, of which a path is made only to read one.
        self._read: dict[Path, dict[str, _Read]] = {path: {} for path in folders}
        self._done = 0
        self._failed = 0
        self._clock = clock
        self._rests_until = -math.inf

    def look(self) -> tuple[int, int]:
        """Return how many episodes are over, and how many of these failed.

        An episode that was run twice, because its worker died, counts twice. Where
        looking takes long, the numbers are those of the last time for a while.
        """
        begin = self._clock()
        if begin >= self._rests_until:
            for folder, known in self._read.items():
                for name in _ledgers(folder):
                    read = known.setdefault(name, _Read())
                    if not read.is_over:
                        self._look_at(folder / name, read)
            end = self._clock()
            if end - begin > _SHORT_S:
                self._rests_until = end + _REST * (end - begin)
        return self._done, self._failed

    def _look_at(self, path: Path, read: _Read) -> None:
        done, failed = read.done, read.failed
        with contextlib.suppress(OSError):
            _read_on(path, read)
        self._done += read.done - done
        self._failed += read.failed - failed


def _ledgers(folder: Path) -> Iterator[str]:
    # Not `glob`, which makes a path of each of the other files, too. It is only for a
    # bar: a folder may not be there yet.
    with contextlib.suppress(OSError):
        for name in names_in(folder):
            if name.startswith(_BEGIN) and name.endswith(_END):
                yield name


def _read_on(path: Path, read: _Read) -> None:
    if path.stat().st_size == read.position:
        return
    with path.open("rb") as file:
        file.seek(read.position)
        *lines, _ = file.read().split(b"\n")
    for line in lines:
        read.position += len(line) + 1
        if line.startswith(_ENDED):
            read.done += 1
            read.failed += _NO_FAILURE not in line
        elif line.startswith(_BATCH):
            read.asked = _episodes_in(line)


def _episodes_in(line: bytes) -> int:
    try:
        return len(json.loads(line)["batch"])
    except (ValueError, TypeError):
        return 0

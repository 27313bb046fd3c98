# SPDX-License-Identifier: Apache-2.0
"""How many episodes are over, counted from ledgers while they grow."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from .ledger import ledger_name

__all__ = ["LedgerCounts"]

# How a line begins that says how an episode ended, and what stands in it where that
# was no failure. Only for a bar: what counts in the end is what `ledger` reads.
_ENDED = b'{"ended"'
_NO_FAILURE = b'"failure": null'


@dataclass
class _Read:
    position: int = 0
    done: int = 0
    failed: int = 0


class LedgerCounts:
    """Counts what ledgers say, reading of each only what is new.

    Args:
        folders: of the tasks.
    """

    def __init__(self, folders: Iterable[Path]) -> None:
        self._folders = list(folders)
        self._read: dict[Path, _Read] = {}

    def look(self) -> tuple[int, int]:
        """Return how many episodes are over, and how many of these failed.

        An episode that was run twice, because its worker died, counts twice.
        """
        for folder in self._folders:
            for path in folder.glob(ledger_name("*")):
                with contextlib.suppress(OSError):
                    _read_on(path, self._read.setdefault(path, _Read()))
        read = self._read.values()
        return sum(each.done for each in read), sum(each.failed for each in read)


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

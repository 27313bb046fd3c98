# SPDX-License-Identifier: Apache-2.0
"""Notes on facts that could not be recreated and had to be believed.

They are stored next to the recreated run, for the process that compares it with the
archive.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from .. import json_text

NOTES_FILE: Final = "maker.json"
# Next to it if only rewards and ends were recreated: the rewards of each step, keyed by
# "<infix>.<episode's number>".
REWARDS_FILE: Final = "rewards.npz"


@dataclass(frozen=True, kw_only=True)
class Note:
    """One fact that was believed.

    Attributes:
        item: "episode 27 of 0.4711" or "recording 0.4711".
        excuse: the name of the excuse that claims it.
        reason: a clause with the reason and the fact that is believed.
        count: number of units that the note covers.
        unit: the unit of `count`.
    """

    item: str
    excuse: str
    reason: str
    count: int = 1
    unit: str = "episode"


class Notes:
    """The facts believed so far."""

    def __init__(self) -> None:
        self.all: list[Note] = []

    def add(self, item: str, excuse: str, reason: str, **counted: Any) -> None:
        """Add a note; `counted` may set its `count` and `unit`."""
        self.all.append(Note(item=item, excuse=excuse, reason=reason, **counted))

    def write(self, folder: Path) -> None:
        """Write the notes into a folder."""
        said = [dataclasses.asdict(note) for note in self.all]
        (folder / NOTES_FILE).write_text(json_text.dumps(said))


def read_notes(folder: Path) -> tuple[Note, ...]:
    """Return the notes in a folder; empty if it has none."""
    path = folder / NOTES_FILE
    if not path.exists():
        return ()
    return tuple(Note(**each) for each in json_text.loads(path.read_text()))

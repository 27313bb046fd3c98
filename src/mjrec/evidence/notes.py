# SPDX-License-Identifier: Apache-2.0
"""What a maker could not make again, and had to believe.

It is written down beside what was made, for the process that compares the two.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from .. import json_text

NOTES_FILE: Final = "maker.json"
# Beside it, where only rewards and ends were recreated: the rewards of each step, by
# "<infix>.<episode's number>".
REWARDS_FILE: Final = "rewards.npz"


@dataclass(frozen=True, kw_only=True)
class Note:
    """One thing that was believed.

    Attributes:
        item: "episode 27 of 0.4711" or "recording 0.4711".
        excuse: the name of the excuse that claims it.
        reason: why, and what is believed, a clause.
        count: how many of `unit` it stands for.
        unit: what is counted.
    """

    item: str
    excuse: str
    reason: str
    count: int = 1
    unit: str = "episode"


class Notes:
    """What was believed so far."""

    def __init__(self) -> None:
        self.all: list[Note] = []

    def add(self, item: str, excuse: str, reason: str, **counted: Any) -> None:
        """Note one thing; `counted` are `count` and `unit`."""
        self.all.append(Note(item=item, excuse=excuse, reason=reason, **counted))

    def write(self, folder: Path) -> None:
        """Write them down in a folder."""
        said = [dataclasses.asdict(note) for note in self.all]
        (folder / NOTES_FILE).write_text(json_text.dumps(said))


def read_notes(folder: Path) -> tuple[Note, ...]:
    """Return what was written down in a folder; nothing where there is nothing."""
    path = folder / NOTES_FILE
    if not path.exists():
        return ()
    return tuple(Note(**each) for each in json_text.loads(path.read_text()))

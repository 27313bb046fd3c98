# SPDX-License-Identifier: Apache-2.0
"""How a packed run and the same run, made again, differ: the words for it."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


class Item(enum.StrEnum):
    """What is proved, a line of the one screen each, in its order."""

    IDENTITY = "identity"
    BEGINNING = "beginning"
    PHYSICS = "physics"
    REWARDS = "rewards and ends"
    SELECTION = "selection of episodes"
    VIDEOS = "videos shown"
    PICTURES = "pictures"
    FILES = "files"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One place where the two differ.

    Attributes:
        item: what it tells against.
        file: its name in the archive, below `data/`; "" for the whole.
        where: the place in it: "states[12].qpos", "episode 27: reward", "frame 13".
        recorded: what the archive has there, short and printable.
        made: what was made again, likewise.
        size: how far off. Of numbers the largest `abs(x - y) / (1 + abs(x))`; of
            frames the root mean square of the worst 8x8 block, in levels of 255. None
            where it is no matter of degree.
        figures: more numbers, by name: `count` of the places alike that this one
            stands for; of frames `psnr`, `ssim` and `block`, the worst of each.
    """

    item: Item
    file: str
    where: str
    recorded: str
    made: str
    size: float | None = None
    figures: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {**fields, "figures": dict(self.figures)}

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> Difference:
        """Return the difference that `to_json` was called of."""
        return cls(**{**said, "item": Item(said["item"])})

# SPDX-License-Identifier: Apache-2.0
"""What comparators say: items that are equal, and places that differ.

A comparator looks at one file of two packed runs. It judges nothing: whether an excuse
allows a difference is decided elsewhere, by the aspect of it.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

from ..formats.monitor_directory import episode_of, infix_of
from .findings import Topic

_LONGEST: Final = 120
_VIDEO_OR_TRAJECTORY: Final = re.compile(r"openaigym\.(video|trajectory)\.")


class Aspect(enum.Enum):
    """How an item differs, which decides what may excuse it.

    Attributes:
        EXACT: it must be equal; no version or machine changes it.
        STATE: numbers of the simulation.
        DERIVED: numbers that the environment computes of states.
        OBSERVED: what the environment's or a wrapper's code gives besides rewards and
            ends: observations, success.
        SOLVER: what only the solver uses to begin from: the warm start.
        MODEL: the compiled model.
        PICTURE: a frame's pixels, as the file shows them.
        HASH: a frame's hash, that follows from its pixels.
        ENCODED: bytes of the encoder that show nothing by themselves.
        STORED: all contents are equal, the bytes that store them are not.
        CLAIM: a version, or a name of hardware.
        STATEMENT: what nothing can make again; or what follows from a file of the
            archive itself, and is right for that. Nothing is to be said of it.
    """

    EXACT = "exact"
    STATE = "state"
    DERIVED = "derived"
    OBSERVED = "observed"
    SOLVER = "solver"
    MODEL = "model"
    PICTURE = "frame"
    HASH = "hash"
    ENCODED = "encoded"
    STORED = "stored"
    CLAIM = "claim"
    STATEMENT = "statement"


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where an item is.

    Attributes:
        topic: what it tells about.
        file: its name below `data/`.
        count: how many `unit` it stands for.
        unit: "episode", "step", "frame", "video", "file".
        episode: the number of the episode that it is of; None where the file says it.
    """

    topic: Topic
    file: str = ""
    count: int = 1
    unit: str = "file"
    episode: int | None = None

    @property
    def scopes(self) -> tuple[str, ...]:
        """What an excuse may name to reach it: episode, recording, file."""
        name = self.file.rpartition("/")[2]
        infix = infix_of(name)
        if infix is None:
            return (name,)
        number = self.episode
        if number is None and _VIDEO_OR_TRAJECTORY.match(name):
            number = episode_of(name)
        episode = () if number is None else (f"episode {number} of {infix}",)
        return (*episode, f"recording {infix}", name)

    @property
    def item(self) -> str:
        """What a finding calls it: the episode, else the file."""
        first = self.scopes[0]
        return first if first.startswith("episode ") else self.file


@dataclass(frozen=True, kw_only=True)
class Same(Place):
    """Something that is equal, bit for bit."""


@dataclass(frozen=True, kw_only=True)
class Difference(Place):
    """One place, or several alike, where the two differ.

    Attributes:
        aspect: how.
        where: "states[12].qpos", "frame 13", "mjrec.schedule".
        how: a clause, as of `unlike`, short and printable.
        size: of numbers the largest `abs(x - y) / (1 + abs(x))`; None where it is no
            matter of degree.
        claim: of a CLAIM, whose: "mujoco", "gl", "ffmpeg", "machine".
        figures: more numbers by name: of PICTURE `psnr`, `ssim` and `block`.
    """

    aspect: Aspect = Aspect.EXACT
    where: str = ""
    how: str
    size: float | None = None
    claim: str = ""
    figures: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def reason(self) -> str:
        """The difference as a clause."""
        return f"{self.where}: {self.how}" if self.where else self.how


def unlike(given: Any, made: Any) -> str:
    """Return how two values differ, as a clause."""
    return f"the archive has {short(given)}, the recreated run has {short(made)}"


def only_in(is_given: bool, value: Any) -> str:
    """Return that only one of the two has a value, as a clause."""
    who = "the archive" if is_given else "the recreated run"
    return f"only {who} has it: {short(value)}"


def relative_error(given: float, made: float) -> float:
    """Return the `size` of a difference between two numbers."""
    return abs(given - made) / (1 + abs(given))


def short(value: Any) -> str:
    """Return a value as one short line of text."""
    text = value if isinstance(value, str) else repr(value)
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]} ..."

# SPDX-License-Identifier: Apache-2.0
"""Results of comparators: items that are equal, and places that differ.

A comparator compares one file of two packed runs. It does not judge: `excuses` decides
by a difference's aspect whether an excuse allows it.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from types import MappingProxyType
from typing import Any, Final

from ..formats.monitor_directory import episode_of, infix_of
from .findings import Topic

_LONGEST: Final = 120
_VIDEO_OR_TRAJECTORY: Final = re.compile(r"openaigym\.(video|trajectory)\.")


class Aspect(enum.Enum):
    """How an item differs, which determines the excuses that may apply.

    Attributes:
        EXACT: values that must be equal; no version or machine changes them.
        STATE: numbers of the simulation.
        VELOCITY: velocities of the simulation.
        DERIVED: numbers that the environment computes from states.
        SUMMED: sums of DERIVED numbers: the returns.
        OBSERVED: outputs of the environment or a wrapper other than rewards and episode
            ends: observations, success.
        SOLVER: the warm start, which only the solver uses.
        MODEL: the compiled model.
        PICTURE: a frame's pixels, as decoded from the file.
        HASH: a frame's hash, which follows from its pixels.
        ENCODED: bytes from the encoder that prove nothing on their own.
        STORED: the contents are equal, but not the bytes that store them.
        CLAIM: a version, or the name of hardware.
        STATEMENT: a value that cannot be recreated, or that follows from a file in the
            archive itself and is correct for that file. It is not reported.
    """

    EXACT = "exact"
    STATE = "state"
    VELOCITY = "velocity"
    DERIVED = "derived"
    SUMMED = "summed"
    OBSERVED = "observed"
    SOLVER = "solver"
    MODEL = "model"
    PICTURE = "frame"
    HASH = "hash"
    ENCODED = "encoded"
    STORED = "stored"
    CLAIM = "claim"
    STATEMENT = "statement"


@dataclass(frozen=True)
class Place:
    """The location of an item.

    Attributes:
        topic: the item's topic.
        file: the file's name below `data/`. Comparators do not set it.
        count: number of units.
        unit: the unit that is counted, such as "episode", "step", "frame", "video" or
            "file".
        episode: the number of the item's episode. None if the file's name contains it,
            or if the item belongs to no episode.
    """

    topic: Topic
    _: KW_ONLY
    file: str = ""
    count: int = 1
    unit: str = "file"
    episode: int | None = None

    @property
    def scopes(self) -> tuple[str, ...]:
        """The names by which an excuse can claim the item: episode, recording, file."""
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
        """The name for findings: the episode if there is one, otherwise the file."""
        first = self.scopes[0]
        return first if first.startswith("episode ") else self.file


@dataclass(frozen=True)
class Same(Place):
    """An item that is bit-identical in both runs."""


@dataclass(frozen=True, kw_only=True)
class Difference(Place):
    """One place, or several similar ones, where the two runs differ.

    Attributes:
        aspect: the kind of difference.
        where: the place in the file: "states[12].qpos", "frame 13", "mjrec.schedule".
        how: the difference as a short, printable clause (see `unlike`).
        size: the largest `abs(x - y) / (1 + abs(x))` for numbers. None if the
            difference has no size.
        claim: the name of the excuse for a CLAIM: "mujoco", "gl", "ffmpeg", "machine".
        figures: additional numbers, keyed by name, such as `psnr`, `ssim` and `block`
            for PICTURE.
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
    """Return the difference between two values as a clause."""
    return f"the archive has {short(given)}; the recreated run has {short(made)}"


def differs(
    topic: Topic, where: str, given: Any, made: Any, *, unit: str = "file"
) -> Difference:
    """Return the difference between two values that must be equal."""
    return Difference(topic, unit=unit, where=where, how=unlike(given, made))


STORED_DIFFERENTLY: Final = Difference(
    Topic.FILES, aspect=Aspect.STORED, how="the same contents, stored differently"
)


def only_in(is_given: bool, value: Any) -> str:
    """Return a clause that says which of the two runs has a value."""
    who = "the archive" if is_given else "the recreated run"
    return f"only {who} has it: {short(value)}"


def short(value: Any) -> str:
    """Return a value as one short, printable line."""
    text = value if isinstance(value, str) else repr(value)
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]} ..."

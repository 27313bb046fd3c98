# SPDX-License-Identifier: Apache-2.0
"""What is to be checked, and how: the facts that go from the parent to the checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from ..verification import Check, Level


@dataclass(frozen=True, kw_only=True)
class Task:
    """A verification that is asked for.

    Attributes:
        recordings: the monitor directory, be it of an unpacked run or as it was
            recorded.
        level: how deep to go.
        sample: how many frames of each video are drawn; None is all of them.
        seed: of the sample.
        trust: the ids of environments that may be made though they are not in the
            registry's own namespaces, because the reader has said so.
        environment: what `environment.json` says; empty where there is none.
        pictures: a folder for pictures of what differs, or None.
    """

    recordings: Path
    level: Level = Level.PIXELS
    sample: int | None = None
    seed: int = 0
    trust: frozenset[str] = frozenset()
    environment: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    pictures: Path | None = None


# Told how much is done, and of how much: `count(done, total)`.
Count: TypeAlias = Callable[[int, int], object]

# A level's checks, one after the other, as they are found.
Checker: TypeAlias = Callable[[Task, Count], Iterator[Check]]

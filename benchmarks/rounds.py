# SPDX-License-Identifier: Apache-2.0
"""Measuring several things fairly: in rounds, each at every place in the order."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

Key = TypeVar("Key", bound=Hashable)
Sample = TypeVar("Sample")
# Tells somebody who waits what is being done.
Say = Callable[[str], None]


def take_turns(
    variants: Mapping[Key, Callable[[], Sample]], *, rounds: int, say: Say
) -> dict[Key, list[Sample]]:
    """Return what each variant gave in each round.

    A machine gets slower and faster while one waits. In a round every variant runs
    once, and each round begins with another one.
    """
    samples: dict[Key, list[Sample]] = {key: [] for key in variants}
    keys = list(variants)
    for number in range(rounds):
        first = number % max(1, len(keys))
        for key in keys[first:] + keys[:first]:
            words = " ".join(map(str, key)) if isinstance(key, tuple) else str(key)
            say(f"round {number + 1} of {rounds}: {words}")
            samples[key].append(variants[key]())
    return samples

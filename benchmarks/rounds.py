# SPDX-License-Identifier: Apache-2.0
"""Fair measurement of several variants in rounds with a changing order."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

Key = TypeVar("Key", bound=Hashable)
Sample = TypeVar("Sample")
# A function that shows the current activity to the user.
Say = Callable[[str], None]


def take_turns(
    variants: Mapping[Key, Callable[[], Sample]], *, rounds: int, say: Say
) -> dict[Key, list[Sample]]:
    """Run all variants once per round, and return the samples of each variant.

    The speed of a machine changes over time. Therefore each round begins with a
    different variant.
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

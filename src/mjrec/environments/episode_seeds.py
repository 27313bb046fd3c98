# SPDX-License-Identifier: Apache-2.0
"""From the seed of a run to the seeds of one episode, and of a process.

The recipe, to be redone by hand::

    words = numpy.random.SeedSequence([seed, episode]).generate_state(3)
    environment, actions, policy = (int(word) >> 1 for word in words)

Each word is 32 bits; its lowest bit is dropped, because some of the generators that
are seeded with it take no more than 31. An episode's seeds depend on nothing but the
two numbers, so any episode can be recorded again without those before it.
"""

from __future__ import annotations

import random
import sys
from dataclasses import dataclass

import numpy as np

from ..errors import InvalidArgument

# SeedSequence cuts larger numbers into words of 32 bits and pads with zeros, so that
# [2**32 + 5, 0] and [5, 1] would be the same episode.
_LIMIT = 2**32


@dataclass(frozen=True)
class EpisodeSeeds:
    """The three seeds of an episode, each from 0 to 2**31 - 1.

    Attributes:
        environment: of the environment's own randomness.
        actions: of the sampling of actions.
        policy: of the policy's own randomness.
    """

    environment: int
    actions: int
    policy: int


def episode_seeds(seed: int, episode: int) -> EpisodeSeeds:
    """Return the seeds of one episode of a run; the module says how they are made.

    Args:
        seed: of the run.
        episode: its number, from 0.

    Raises:
        InvalidArgument: one is not a whole number from 0 to 2**32 - 1.
    """
    entropy = [_checked("seed", seed), _checked("episode", episode)]
    words = np.random.SeedSequence(entropy).generate_state(3)
    environment, actions, policy = (int(word) >> 1 for word in words)
    return EpisodeSeeds(environment=environment, actions=actions, policy=policy)


def seed_global_generators(seed: int) -> None:
    """Seed Python's, NumPy's and, where it is loaded, PyTorch's generators.

    Policies draw from them (`numpy.random.uniform`, dropout) without knowing of any
    seed. For processes of our own only: in a user's they are the user's.

    Args:
        seed: from 0 to 2**32 - 1.
    """
    random.seed(seed)
    np.random.seed(seed)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)


def _checked(name: str, number: object) -> int:
    whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    if not whole or not 0 <= number < _LIMIT:  # type: ignore[operator]  # is a number
        raise InvalidArgument(
            f"{name} must be a whole number from 0 to {_LIMIT - 1}, got {number!r}."
        )
    return int(number)  # type: ignore[call-overload, no-any-return]  # is a number

# SPDX-License-Identifier: Apache-2.0
"""Derivation of an episode's seeds from the run's seed.

To reproduce the seeds by hand::

    words = numpy.random.SeedSequence([seed, episode]).generate_state(3)
    environment, actions, policy = (int(word) >> 1 for word in words)

Each word has 32 bits. Its lowest bit is dropped, because some generators accept only 31
bits. An episode's seeds depend only on `seed` and `episode`, so any episode can be
reproduced without running earlier episodes.
"""

from __future__ import annotations

import random
import sys
from dataclasses import dataclass

import numpy as np

from ..errors import InvalidArgument

# SeedSequence splits larger numbers into 32-bit words and pads with zeros, so [2**32 +
# 5, 0] and [5, 1] would yield the same episode.
_LIMIT = 2**32


@dataclass(frozen=True)
class EpisodeSeeds:
    """The three seeds of an episode, each from 0 to 2**31 - 1.

    Attributes:
        environment: seed for the environment's own randomness.
        actions: seed for the sampling of actions.
        policy: seed for the policy's own randomness.
    """

    environment: int
    actions: int
    policy: int


def episode_seeds(seed: int, episode: int) -> EpisodeSeeds:
    """Return the seeds of one episode in a run; the module explains the derivation.

    Args:
        seed: the run's seed.
        episode: the episode's number, from 0.

    Raises:
        InvalidArgument: an argument is not a whole number from 0 to 2**32 - 1.
    """
    entropy = [_checked("seed", seed), _checked("episode", episode)]
    words = np.random.SeedSequence(entropy).generate_state(3)
    environment, actions, policy = (int(word) >> 1 for word in words)
    return EpisodeSeeds(environment=environment, actions=actions, policy=policy)


def seed_global_generators(seed: int) -> None:
    """Seed the generators of Python, NumPy and, if it is loaded, PyTorch.

    Policies may draw from these generators (`numpy.random.uniform`, dropout) instead of
    using a seed. Call this only in processes that mjrec starts, because a user's
    process has its own seeds.

    Args:
        seed: the seed, from 0 to 2**32 - 1.
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
            f"{name} must be a whole number from 0 to {_LIMIT - 1}, not {number!r}."
        )
    return int(number)  # type: ignore[call-overload, no-any-return]  # is a number

# SPDX-License-Identifier: Apache-2.0
"""The seeds of an episode."""

import dataclasses

import numpy as np
import pytest

import mjrec
from mjrec.environments.episode_seeds import EpisodeSeeds, episode_seeds


def test_seeds_can_be_redone_by_hand():
    """The recipe in the module's docstring gives the same numbers."""
    words = np.random.SeedSequence([12, 34]).generate_state(3)
    by_hand = [int(word) >> 1 for word in words]
    assert list(dataclasses.astuple(episode_seeds(12, 34))) == by_hand


def test_seeds_stay_what_they_were():
    """Recordings of other years must be repeatable: the numbers are part of them."""
    assert episode_seeds(0, 0) == EpisodeSeeds(
        environment=1484405855, actions=1838574579, policy=372825380
    )
    assert episode_seeds(0, 1) == EpisodeSeeds(
        environment=1982462498, actions=679461430, policy=1947452081
    )


@pytest.mark.parametrize("bad", [-1, 2**32, 1.0, True, None, "1"])
def test_what_is_no_seed_is_refused(bad):
    """The message names the argument and says what it may be."""
    with pytest.raises(mjrec.InvalidArgument, match=r"seed must be .*4294967295"):
        episode_seeds(bad, 0)
    with pytest.raises(mjrec.InvalidArgument, match="episode must be"):
        episode_seeds(0, bad)

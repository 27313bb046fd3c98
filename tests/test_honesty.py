# SPDX-License-Identifier: Apache-2.0
"""What inputs say of their author."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mjrec.environments.episode_seeds import episode_seeds
from mjrec.evidence.findings import Finding, Outcome
from mjrec.evidence.honesty import remarks
from mjrec.evidence.inputs import EpisodeInputs, Inputs, RecordingInputs


def seed_of(run: int, episode: int) -> int:
    """Return the seed that the stated rule gives."""
    return episode_seeds(run, episode).environment


def said(
    *recordings: Sequence[EpisodeInputs], first: int = 0, **options: Any
) -> list[Finding]:
    """Return what is said of recordings of these episodes."""
    inputs = Inputs(
        recordings=[
            RecordingInputs(
                infix=f"{number}.1",
                env_id="A-v0",
                environment=None,
                options=options,
                first_episode_id=first,
                episodes=episodes,
            )
            for number, episodes in enumerate(recordings)
        ]
    )
    names = [e.actions for each in recordings for e in each if e.actions]
    # Of one name in the test is one content.
    arrays = {name: np.full(3, ord(name[0])) for name in names}
    return list(remarks(inputs, arrays))


def episode(number: int, **inputs: Any) -> EpisodeInputs:
    """Return an episode."""
    return EpisodeInputs(episode_id=number, steps=3, **inputs)


@pytest.mark.parametrize(
    ("episodes", "options", "rule"),
    [
        ([episode(0, seed=7), episode(1)], {}, "one seed, 7, at the first reset"),
        (
            [episode(n, seed=seed_of(5, n)) for n in range(3)],
            {"seed": 5},
            r"SeedSequence([5, i]) for episode i",
        ),
        (
            [
                episode(n, seed=seed_of(2, n), evaluation={"seed": 2, "episode": n})
                for n in range(2)
            ],
            {},
            "SeedSequence([S, i]) for episode i, S of 2",
        ),
        ([episode(0, seed=3), episode(1, seed=9)], {}, "seeds chosen by the author"),
        (
            [episode(n, seed=seed_of(5, n + 1)) for n in range(2)],
            {"seed": 5},
            "seeds chosen by the author",
        ),
        (
            [episode(0, seed=1, evaluation={"seed": 2, "episode": 0})],
            {},
            "seeds chosen by the author",
        ),
    ],
)
def test_seeds_follow_a_stated_rule_or_are_the_authors(
    episodes: list[EpisodeInputs], options: dict[str, Any], rule: str
) -> None:
    """From the first episode of the recording on."""
    [finding] = said(episodes, **options)
    assert rule in finding.reason
    assert finding.outcome is Outcome.NOTED


def test_gaps_are_in_the_first_line() -> None:
    """An episode that is not there is no episode of a whole recording."""
    [finding] = said([episode(0), episode(1), episode(4)])
    assert finding.is_headline
    assert finding.outcome is Outcome.DIFFERENT
    assert "missing: 2, 3" in finding.reason


def test_a_missing_predecessor_is_in_the_first_line() -> None:
    """Of a monitor that went on from others; where they are there, nothing is said."""
    [finding] = said([episode(2)], first=2)
    assert finding.is_headline
    assert "0, 1 are missing" in finding.reason
    inputs = Inputs(
        recordings=[
            RecordingInputs(
                infix=f"{first}.1",
                env_id="A-v0",
                environment=None,
                first_episode_id=first,
                episodes=[episode(first)],
            )
            for first in (0, 1)
        ]
    )
    assert list(remarks(inputs, {})) == []


def test_equal_episodes_count_once_and_are_named() -> None:
    """Wherever they are; other actions, or another beginning, are another episode."""
    first = [episode(0, seed=1, actions="a"), episode(1, seed=2, actions="a2")]
    second = [episode(0, seed=1, actions="a3"), episode(1, seed=1, actions="b")]
    found = [each for each in said(first, second) if each.is_headline]
    [finding] = found
    assert "episode 0 of 0.1, episode 0 of 1.1" in finding.reason
    assert finding.outcome is Outcome.BELIEVED
    assert finding.count == 1


def test_cut_episodes_are_noted() -> None:
    """They are in no statistics."""
    [finding] = said([episode(0), episode(1, cut="reset")])
    assert finding.outcome is Outcome.NOTED
    assert "cut off: 1" in finding.reason

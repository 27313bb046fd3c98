# SPDX-License-Identifier: Apache-2.0
"""Remarks on inputs that an author may have chosen."""

import numpy as np
import pytest

from mjrec.environments.episode_seeds import episode_seeds
from mjrec.evidence.findings import Outcome
from mjrec.evidence.honesty import remarks
from mjrec.evidence.inputs import EpisodeInputs, Inputs, RecordingInputs

NOTED, BELIEVED, DIFFERENT = Outcome.NOTED, Outcome.BELIEVED, Outcome.DIFFERENT


def recording(number, *episodes, **inputs):
    """Return a recording of these episodes."""
    usual = {"infix": f"{number}.1", "env_id": "A-v0", "environment": None}
    return RecordingInputs(**{**usual, **inputs}, episodes=episodes)


def episode(number, **inputs):
    """Return an episode, with actions if it has arrays."""
    has_actions = "arrays" in inputs
    return EpisodeInputs(episode_id=number, steps=3, has_actions=has_actions, **inputs)


def evaluated(number, of, **inputs):
    """Return an episode of an evaluation with seed 2."""
    return episode(number, evaluation={"seed": 2, "episode": of}, **inputs)


def found(*recordings):
    """Return the remarks; arrays whose names share the first letter are equal."""
    names = [e.arrays for each in recordings for e in each.episodes if e.arrays]
    arrays = {name: np.full(3, ord(name[0])) for name in names}
    return list(remarks(Inputs(recordings=recordings), arrays))


def seed_of(run, number):
    """Return an episode's seed by the stated rule."""
    return episode_seeds(run, number).environment


CHOSEN = "seeds chosen by the author"


@pytest.mark.parametrize(
    ("episodes", "rule"),
    [
        ([episode(0, seed=7), episode(1)], "one seed, 7, at the first reset"),
        (
            [episode(n, seed=seed_of(5, n)) for n in range(3)],
            r"SeedSequence([5, i]) for episode i",
        ),
        (
            [evaluated(n, n, seed=seed_of(2, n)) for n in range(2)],
            "SeedSequence([S, i]) for episode i, S in 2",
        ),
        ([episode(0, seed=3), episode(1, seed=9)], CHOSEN),
        ([episode(n, seed=seed_of(5, n + 1)) for n in range(2)], CHOSEN),
        ([evaluated(0, 0, seed=1)], CHOSEN),
    ],
)
def test_seeds_follow_a_stated_rule_or_are_the_authors(episodes, rule):
    [finding] = found(recording(0, *episodes, options={"seed": 5}))
    assert rule in finding.reason
    assert finding.outcome is NOTED


def named(env_id, environment):
    return recording(0, episode(0), env_id=env_id, environment=environment)


HOPPER = {"id": "Hopper-v5"}


@pytest.mark.parametrize(
    ("recordings", "outcome", "reason"),
    [
        # A complete recording has all episodes.
        ([recording(0, episode(0), episode(1), episode(4))], DIFFERENT, "ing: 2, 3"),
        # Episodes of the resumed monitor are missing too.
        ([recording(0, episode(2), first_episode_id=2)], BELIEVED, "0, 1 are missing"),
        # Statistics leave these episodes out.
        ([recording(0, episode(0), episode(1, cut="reset"))], NOTED, "cut off: 1"),
        # By resuming, an author can drop bad episodes.
        (
            [
                recording(0, episode(0), episode(1, cut="close")),
                recording(1, episode(2), first_episode_id=2),
            ],
            BELIEVED,
            "continues after them",
        ),
        # Averages may leave out episodes of one type.
        (
            [recording(0, episode(0, type="t"), episode(1, type="e"))],
            NOTED,
            "1 of 2 episodes are labeled training",
        ),
        # An author may choose the best episodes; chunks count together.
        (
            [
                recording(0, evaluated(0, 0), evaluated(1, 1)),
                recording(1, evaluated(0, 2), evaluated(1, 5)),
            ],
            BELIEVED,
            "3, 4",
        ),
        # Without states, equal seeds and actions are a repeated episode.
        (
            [
                recording(0, episode(0, seed=1, arrays="a"), episode(1, arrays="a2")),
                recording(1, episode(0, seed=1, arrays="a3"), episode(1, arrays="b")),
            ],
            BELIEVED,
            "episode 0 of 0.1, episode 0 of 1.1",
        ),
        # Equal states are a repeated episode, with any seeds and actions.
        (
            [
                recording(0, episode(0, seed=1, arrays="a", played="x")),
                recording(1, episode(0, seed=2, arrays="b", played="x")),
                recording(2, episode(0, seed=1, arrays="c", played="y")),
            ],
            BELIEVED,
            "episode 0 of 0.1, episode 0 of 1.1;",
        ),
        # Files may be named after another environment.
        ([named("ours", HOPPER)], BELIEVED, ""),
        ([named("Humanoid-v5", HOPPER)], DIFFERENT, ""),
        ([named("Hopper-v5", {**HOPPER, "framework": "mjcf"})], NOTED, ""),
    ],
)
def test_flattering_choices_are_in_the_first_lines(recordings, outcome, reason):
    [finding] = [each for each in found(*recordings) if each.is_headline]
    assert finding.outcome is outcome
    assert reason in finding.reason


def test_resumed_monitor_of_the_same_environment_is_not_missing():
    second = recording(1, episode(1), first_episode_id=1)
    assert found(recording(0, episode(0)), second) == []
    findings = found(named("A-v0", {"id": "Easier-v0"}), second)
    assert any("0 are missing" in each.reason for each in findings)


def test_huge_episode_numbers_take_no_memory():
    [gap, absent] = found(recording(0, episode(10**15), first_episode_id=10**14))
    assert "and 899999999999995 more" in gap.reason
    assert absent.count == 10**14

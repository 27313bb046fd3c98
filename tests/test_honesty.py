# SPDX-License-Identifier: Apache-2.0
"""What inputs say of their author."""

import dataclasses

import numpy as np
import pytest

from mjrec.environments.episode_seeds import episode_seeds
from mjrec.evidence.findings import Outcome
from mjrec.evidence.honesty import remarks
from mjrec.evidence.inputs import EpisodeInputs, Inputs, RecordingInputs


def seed_of(run, episode):
    """Return the seed that the stated rule gives."""
    return episode_seeds(run, episode).environment


def recording(number, episodes, **inputs):
    """Return a recording of these episodes."""
    usual = {"infix": f"{number}.1", "env_id": "A-v0", "environment": None}
    return RecordingInputs(**{**usual, **inputs}, episodes=episodes)


def said(*recordings, first=0, **options):
    """Return what is said of recordings of these episodes."""
    more = {"options": options, "first_episode_id": first}
    inputs = Inputs(
        recordings=[
            recording(number, episodes, **more)
            for number, episodes in enumerate(recordings)
        ]
    )
    names = [e.arrays for each in recordings for e in each if e.arrays]
    # Of one name in the test is one content.
    arrays = {name: np.full(3, ord(name[0])) for name in names}
    return list(remarks(inputs, arrays))


def episode(number, **inputs):
    """Return an episode, with actions if it has arrays."""
    has_actions = "arrays" in inputs
    return EpisodeInputs(episode_id=number, steps=3, has_actions=has_actions, **inputs)


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
            "SeedSequence([S, i]) for episode i, S in 2",
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
def test_seeds_follow_a_stated_rule_or_are_the_authors(episodes, options, rule):
    """From the first episode of the recording on."""
    [finding] = said(episodes, **options)
    assert rule in finding.reason
    assert finding.outcome is Outcome.NOTED


def test_gaps_are_in_the_first_line():
    """An episode that is not there is no episode of a whole recording."""
    [finding] = said([episode(0), episode(1), episode(4)])
    assert finding.is_headline
    assert finding.outcome is Outcome.DIFFERENT
    assert "missing: 2, 3" in finding.reason


def test_a_missing_predecessor_is_in_the_first_line():
    """Of a monitor that went on from others; where they are there, nothing is said."""
    [finding] = said([episode(2)], first=2)
    assert finding.is_headline
    assert "0, 1 are missing" in finding.reason
    chain = [recording(n, [episode(n)], first_episode_id=n) for n in (0, 1)]
    assert list(remarks(Inputs(recordings=chain), {})) == []
    # Those of another environment stand in for nothing.
    chain[0] = dataclasses.replace(chain[0], environment={"id": "Easier-v0"})
    found = list(remarks(Inputs(recordings=chain), {}))
    assert any("0 are missing" in each.reason for each in found)


def test_equal_episodes_count_once_and_are_named():
    """Wherever they are; other actions, or another beginning, are another episode."""
    first = [episode(0, seed=1, arrays="a"), episode(1, seed=2, arrays="a2")]
    second = [episode(0, seed=1, arrays="a3"), episode(1, seed=1, arrays="b")]
    found = [each for each in said(first, second) if each.is_headline]
    [finding] = found
    assert "episode 0 of 0.1, episode 0 of 1.1" in finding.reason
    assert finding.outcome is Outcome.BELIEVED
    assert finding.count == 1


def test_cut_episodes_are_in_the_first_line():
    """They are in no statistics."""
    [finding] = said([episode(0), episode(1, cut="reset")])
    assert finding.outcome is Outcome.NOTED
    assert finding.is_headline
    assert "cut off: 1" in finding.reason


def test_closing_and_going_on_leaves_episodes_out():
    """A run is closed once; whoever resumes can drop each episode that goes wrong."""
    first = recording(0, [episode(0), episode(1, cut="close")])
    second = recording(1, [episode(2)], first_episode_id=2)
    [finding] = remarks(Inputs(recordings=[first, second]), {})
    assert finding.outcome is Outcome.BELIEVED
    assert "continues after them" in finding.reason


@pytest.mark.parametrize(
    ("name", "environment", "outcome"),
    [
        ("Humanoid-v5", {"id": "Hopper-v5"}, Outcome.DIFFERENT),
        ("our hopper", {"id": "Hopper-v5"}, Outcome.BELIEVED),
        ("Hopper-v5", {"id": "Hopper-v5", "framework": "mjcf"}, Outcome.NOTED),
    ],
)
def test_an_environment_is_what_it_is_called(name, environment, outcome):
    """All files bear the name, and another environment was run."""
    run = recording(0, [episode(0)], env_id=name, environment=environment)
    [finding] = remarks(Inputs(recordings=[run]), {})
    assert finding.is_headline
    assert finding.outcome is outcome


def test_training_episodes_among_evaluations_are_named():
    """An average over the others would leave them out."""
    [finding] = said([episode(0, type="t"), episode(1, type="e")])
    assert finding.is_headline
    assert "1 of 2 episodes are labelled training" in finding.reason


def test_episodes_of_an_evaluation_are_numbered_without_gaps():
    """The best of many would be a choice; chunks of one evaluation count together."""
    chunks = [
        [episode(k, evaluation={"seed": 2, "episode": n}) for k, n in enumerate(each)]
        for each in ((0, 1), (2, 5))
    ]
    [finding] = [each for each in said(*chunks) if each.is_headline]
    assert finding.outcome is Outcome.BELIEVED
    assert "3, 4" in finding.reason


def test_huge_numbers_take_no_memory():
    """A stranger's archive may have any."""
    [gap, absent] = said([episode(10**15)], first=10**14)
    assert "and 899999999999995 more" in gap.reason
    assert absent.count == 10**14

# SPDX-License-Identifier: Apache-2.0
"""A verification on one screen: the verdict, excuses with costs, a line a topic."""

from __future__ import annotations

import io

import pytest
import rich.console
from verifications import HOSTILE, excuse, finding, verification

from mjrec.commands.verify import show_verification
from mjrec.evidence import summary
from mjrec.evidence.findings import Finding, Level, Outcome, Topic, Verification
from mjrec.plain_text import counted


def screen(made: Verification, **options: bool) -> str:
    stream = io.StringIO()
    console = rich.console.Console(file=stream, width=120)
    show_verification(made, console, **options)
    return stream.getvalue()


def gl_frames(outcome: Outcome = Outcome.WITHIN_TOLERANCE) -> Finding:
    return finding(
        outcome,
        topic=Topic.PICTURES,
        count=500,
        unit="frame",
        excuse="gl",
        figures={"psnr": 33.12},
    )


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (verification(finding()), "PASS  run.zip: everything was recreated"),
        (
            verification(finding(), gl_frames(), excuses=(excuse(allowed=True),)),
            "is equal, or allowed (gl).",
        ),
        (verification(finding(), gl_frames()), "PARTLY  run.zip: nothing contradicts"),
        (
            verification(finding(Outcome.NOTED, topic=Topic.FILES), level=Level.FILES),
            "PARTLY  run.zip: files are unchanged",
        ),
        (
            verification(finding(Outcome.DIFFERENT)),
            "it does not match what its inputs produce",
        ),
        (verification(), "FAIL  run.zip: nothing could be recreated"),
    ],
)
def test_the_verdict_comes_first(made: Verification, words: str) -> None:
    """In words, on the first line."""
    assert words in screen(made).splitlines()[0]


def test_gaps_stand_beside_the_verdict() -> None:
    """Before all else."""
    gap = finding(
        Outcome.BELIEVED, item="", reason="episode 3 is missing", is_headline=True
    )
    assert (
        "episode 3 is missing" in screen(verification(finding(), gap)).splitlines()[1]
    )


def test_an_excuse_says_what_it_costs() -> None:
    """The claim, the reader's own, and how much was believed for it."""
    made = verification(finding(), gl_frames(), excuses=(excuse(items=tuple("abcde")),))
    assert summary.excuses(made) == [
        "gl NVIDIA H100 (here llvmpipe) of a, b, c and 2 more: frames are alike; "
        "500 frames within tolerance, the worst 33.1 dB"
    ]
    refuted = verification(excuses=(excuse(refuted=True),))
    assert "refuted" in summary.excuses(refuted)[0]


def test_claims_that_nothing_needs_share_a_line() -> None:
    """They cost nothing."""
    names = ("python", "zlib")
    idle = [excuse(name=n, claimed="1", here="2", is_needed=False) for n in names]
    assert summary.excuses(verification(excuses=tuple(idle))) == [
        "claimed, but not needed: python 1 (here 2); zlib 1 (here 2)"
    ]


def test_each_topic_has_a_line_with_counts() -> None:
    """The worst outcome, and how much of what."""
    believed = finding(
        Outcome.BELIEVED,
        topic=Topic.REWARDS,
        count=988,
        unit="episode",
        reason="their actions were not kept",
    )
    made = finding(topic=Topic.REWARDS, unit="episode")
    noted = finding(
        Outcome.NOTED,
        topic=Topic.VIDEOS,
        count=2,
        unit="video",
        reason="plays at 2 times real time",
    )
    shown = verification(finding(), made, believed, noted)
    lines = {line.topic: (line.outcome, line.text) for line in summary.lines(shown)}
    assert list(lines) == list(Topic)
    assert lines[Topic.PHYSICS] == ("recreated", "12 steps")
    assert lines[Topic.REWARDS] == (
        "believed",
        "12 episodes recreated; 988 episodes believed: their actions were not kept",
    )
    assert lines[Topic.VIDEOS] == (
        "not looked at",
        "plays at 2 times real time (2 videos)",
    )


def test_one_screen_is_enough_and_verbose_has_the_rest() -> None:
    """However many places differ."""
    many = verification(
        *(finding(Outcome.DIFFERENT, reason=f"place {n}") for n in range(100)),
        facts={"mujoco": "3.17.0"},
        inputs={"recording 0.u": {"max_episode_steps": 12}},
    )
    short, long = screen(many), screen(many, verbose=True)
    assert len(short.splitlines()) <= 30
    assert "and 92 more" in short
    assert "max_episode_steps 12" in short
    assert "place 99" in long
    assert "mujoco: 3.17.0" in long


def test_hostile_text_gives_a_terminal_no_orders() -> None:
    """What cannot be printed is spelled out, and marks of ours are text."""
    shown = screen(
        verification(
            finding(Outcome.DIFFERENT, item=HOSTILE, reason="\x1b[2J[bold]"),
            excuses=(excuse(claimed=HOSTILE),),
            inputs={"a": {HOSTILE: HOSTILE}},
        ),
        verbose=True,
    )
    assert "\x1b" not in shown
    assert "\u202e" not in shown
    assert "[bold]" in shown


@pytest.mark.parametrize(
    ("count", "unit", "words"),
    [
        (1, "step", "1 step"),
        (1200, "step", "1,200 steps"),
        (2, "trajectory", "2 trajectories"),
        (2, "frame hash", "2 frame hashes"),
    ],
)
def test_things_are_counted_in_words(count: int, unit: str, words: str) -> None:
    """With thousands set apart."""
    assert counted(count, unit) == words

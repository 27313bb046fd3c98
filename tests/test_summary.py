# SPDX-License-Identifier: Apache-2.0
"""A verification on one screen: the verdict, excuses with costs, a line a topic."""

import dataclasses
import io

import pytest
import rich.console
from verifications import HOSTILE, excuse, finding, verification

from mjrec.commands.verify import show_verification
from mjrec.evidence import summary
from mjrec.evidence.findings import Outcome, Topic


def screen(made, **options):
    stream = io.StringIO()
    console = rich.console.Console(file=stream, width=120)
    show_verification(made, console, **options)
    return stream.getvalue()


GL_FRAMES = finding(
    Outcome.WITHIN_TOLERANCE,
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
            verification(finding(), GL_FRAMES, excuses=(excuse(allowed=True),)),
            "is equal, or allowed (gl).",
        ),
        (verification(finding(), GL_FRAMES), "PARTLY  run.zip: nothing contradicts"),
        (
            verification(finding(Outcome.DIFFERENT)),
            "it does not match what its inputs produce",
        ),
        (verification(), "FAIL  run.zip: nothing could be recreated"),
    ],
)
def test_the_verdict_comes_first(made, words):
    """In words, on the first line; gaps stand beside it."""
    assert words in screen(made).splitlines()[0]
    gap = finding(Outcome.BELIEVED, reason="episode 3 is missing", is_headline=True)
    with_gap = dataclasses.replace(made, findings=(*made.findings, gap))
    assert "episode 3 is missing" in screen(with_gap).splitlines()[1]


def test_an_excuse_says_what_it_costs():
    """The claim, the reader's own, and how much was believed for it."""
    made = verification(finding(), GL_FRAMES, excuses=(excuse(items=tuple("abcde")),))
    assert summary.excuses(made) == [
        "gl NVIDIA H100 (here llvmpipe) of a, b, c and 2 more: frames are alike; "
        "500 frames within tolerance, the worst 33.1 dB"
    ]
    refuted = verification(excuses=(excuse(refuted=True),))
    assert "refuted" in summary.excuses(refuted)[0]
    # What nothing needs costs nothing, and shares a line.
    idle = {"claimed": "1", "here": "2", "is_needed": False}
    excuses = tuple(excuse(name=name, **idle) for name in ("python", "zlib"))
    assert summary.excuses(verification(excuses=excuses)) == [
        "claimed, but not needed: python 1 (here 2); zlib 1 (here 2)"
    ]


def test_each_topic_has_a_line_with_counts():
    """The worst outcome, and how much of what."""
    rewards = {"topic": Topic.REWARDS, "unit": "episode"}
    why, fast = "their actions were not kept", "plays at 2 times real time"
    shown = verification(
        finding(),
        finding(**rewards),
        finding(Outcome.BELIEVED, **rewards, count=1988, reason=why),
        finding(Outcome.NOTED, topic=Topic.VIDEOS, count=2, unit="video", reason=fast),
    )
    lines = {line.topic: (line.outcome, line.text) for line in summary.lines(shown)}
    assert list(lines) == list(Topic)
    assert lines[Topic.PHYSICS] == ("recreated", "12 steps")
    assert lines[Topic.REWARDS] == (
        "believed",
        f"12 episodes recreated; 1,988 episodes believed: {why}",
    )
    assert lines[Topic.VIDEOS] == ("not looked at", f"{fast} (2 videos)")


def test_one_screen_is_enough_and_verbose_has_the_rest():
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


def test_hostile_text_gives_a_terminal_no_orders():
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

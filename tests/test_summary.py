# SPDX-License-Identifier: Apache-2.0
"""A verification on one screen: verdict, excuses with costs, a line for each topic."""

import dataclasses
import io

import pytest
import rich.console
from verifications import HOSTILE, excuse, finding, verification

from mjrec.commands.verify import show_verification
from mjrec.evidence import summary
from mjrec.evidence.findings import Outcome, Topic


def screen(result, **options):
    stream = io.StringIO()
    console = rich.console.Console(file=stream, width=120)
    show_verification(result, console, **options)
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
    ("result", "words"),
    [
        (verification(finding()), "PASS  run.zip: everything was recreated"),
        (
            verification(finding(), GL_FRAMES, excuses=(excuse(allowed=True),)),
            "matches or is allowed (gl).",
        ),
        (verification(finding(), GL_FRAMES), "PARTLY  run.zip: nothing contradicts"),
        (
            verification(finding(Outcome.DIFFERENT)),
            "it does not match what its inputs produce",
        ),
        (verification(), "FAIL  run.zip: nothing could be recreated"),
    ],
)
def test_verdict_and_gaps_are_the_first_lines(result, words):
    assert words in screen(result).splitlines()[0]
    gap = finding(Outcome.BELIEVED, reason="episode 3 is missing", is_headline=True)
    with_gap = dataclasses.replace(result, findings=(*result.findings, gap))
    assert "episode 3 is missing" in screen(with_gap).splitlines()[1]


def test_excuses_state_claim_and_cost():
    result = verification(finding(), GL_FRAMES, excuses=(excuse(items=tuple("abcde")),))
    assert summary.excuses(result) == [
        "gl NVIDIA H100 (here llvmpipe) of a, b, c and 2 more: frames are alike; "
        "500 frames within tolerance, the worst 33.1 dB"
    ]
    refuted = verification(excuses=(excuse(refuted=True),))
    assert "refuted" in summary.excuses(refuted)[0]
    # Excuses without cost share a line.
    idle = {"claimed": "1", "here": "2", "is_needed": False}
    excuses = tuple(excuse(name=name, **idle) for name in ("python", "zlib"))
    assert summary.excuses(verification(excuses=excuses)) == [
        "claimed, but not needed: python 1 (here 2); zlib 1 (here 2)"
    ]


def test_each_topic_has_a_line_with_its_worst_outcome_and_counts():
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


def test_many_differences_fit_one_screen_and_verbose_has_all():
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


def test_control_characters_and_markup_are_escaped():
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

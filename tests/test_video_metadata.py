# SPDX-License-Identifier: Apache-2.0
"""What metadata says of steps and of time."""

from fractions import Fraction

from mjrec.formats.video_metadata import StepRuns, timing_facts


def test_steps_are_runs_and_timing_is_in_exact_fractions():
    """The last frame is always taken; a step may have several; thirds stay thirds."""
    assert StepRuns([0, 4, 8, 10], stride=4).ranges == [[0, 8], [10, 10]]
    assert StepRuns([0, 1, 1, 2]).ranges == [[0, 1], [1, 2]]
    facts = timing_facts(
        StepRuns([0, 2, 4], stride=2),
        fps=Fraction(100, 3),
        timestep=Fraction(3, 400),
        stride=2,
    )
    assert facts == {
        "fps": "100/3",
        "timestep": "3/400",
        # Simulated seconds in a second of video.
        "playback_speed": 0.5,
        "stride": 2,
        "frame_count": 3,
        "frame_steps": [[0, 4]],
    }

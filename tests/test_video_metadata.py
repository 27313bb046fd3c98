# SPDX-License-Identifier: Apache-2.0
"""What a video's metadata says is the same, whoever made the video."""

from __future__ import annotations

from fractions import Fraction

import pytest

from mjrec.formats.video_metadata import (
    StepRuns,
    playback_speed,
    timing_facts,
)


def test_steps_a_stride_apart_are_one_run() -> None:
    """The last frame, which is always taken, is a run of its own where it is nearer."""
    assert StepRuns([0, 4, 8, 12], stride=4).ranges == [[0, 12]]
    assert StepRuns([0, 4, 8, 10], stride=4).ranges == [[0, 8], [10, 10]]


def test_a_step_with_several_frames_is_no_run() -> None:
    """Each frame of the same step is noted."""
    runs = StepRuns([0, 1, 1, 2])
    assert runs.ranges == [[0, 1], [1, 2]]
    assert runs.total == 4


@pytest.mark.parametrize(
    ("fps", "steps_per_frame", "speed"),
    [(40, Fraction(1), 2.0), (10, Fraction(2), 1.0), (40, Fraction(1, 2), 1.0)],
)
def test_playback_speed(fps: int, steps_per_frame: Fraction, speed: float) -> None:
    """Simulated seconds in a second of video: rate times what a frame stands for."""
    assert playback_speed(Fraction(fps), Fraction(1, 20), steps_per_frame) == speed


def test_timing_is_in_exact_fractions() -> None:
    """Rate and timestep are text, so that thirds stay thirds."""
    facts = timing_facts(
        StepRuns([0, 2, 4], stride=2),
        fps=Fraction(100, 3),
        timestep=Fraction(3, 200),
        stride=2,
    )
    assert facts == {
        "fps": "100/3",
        "timestep": "3/200",
        "playback_speed": 1.0,
        "stride": 2,
        "frame_count": 3,
        "frame_steps": [[0, 4]],
    }

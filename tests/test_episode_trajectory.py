# SPDX-License-Identifier: Apache-2.0
"""What goes wrong with a trajectory ends it, and the episode only if that was asked."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit
from trajectories_by_hand import INFIX, new_logs

from mjrec import FileNotWritten
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.recorder.deferred_video import DeferredVideo
from mjrec.recorder.episode_trajectory import EpisodeTrajectory
from mjrec.recorder.trajectory_recorder import Pace, TrajectoryRecorder

# So large that the tail has room for four.
ACTION = np.zeros(100_000, np.float32)
LIMIT = 5_000_000
NAME = trajectory_prefix(INFIX, 3)


def trajectory(directory: Path, *, tolerated: bool) -> EpisodeTrajectory:
    """Return one of a simulation whose state cannot be seen, and that has a video."""
    recorder = TrajectoryRecorder(
        new_logs(directory),
        NAME,
        facts={},
        states=None,
        start=None,
        pace=Pace(clock=lambda: None, declared=lambda: Fraction(30)),
    )
    of_episode = EpisodeTrajectory(
        recorder,
        episode_id=3,
        promise={"name": "v.mp4"},
        stays=True,
        tolerates=lambda error: tolerated,
    )
    of_episode.deferred = DeferredVideo(directory / "v", recorder)
    return of_episode


def take_steps(of_episode: EpisodeTrajectory, count: int) -> None:
    for _ in range(count):
        of_episode.before_step(ACTION)
        of_episode.step(1.0, False, False, None, False, True)


def test_a_step_that_was_not_recorded_is_lacking(tmp_path: Path) -> None:
    """Though nothing had been said against it."""
    of_episode = trajectory(tmp_path, tolerated=True)
    take_steps(of_episode, 2)
    assert not of_episode.lacks(2)
    assert of_episode.lacks(3)
    of_episode.recorder.stop("the disk is full")
    assert not of_episode.lacks(3)
    of_episode.discard()


def test_a_full_disk_ends_the_trajectory_only(tmp_path: Path) -> None:
    """Where that is tolerated: steps go on, and the video says why it is short."""
    of_episode = trajectory(tmp_path, tolerated=True)
    with file_size_limit(LIMIT):
        take_steps(of_episode, 12)
        of_episode.end({})
    assert of_episode.recorder.is_stopped
    assert 0 < of_episode.recorder.steps < 12
    assert of_episode.deferred is not None
    assert of_episode.deferred.broken
    assert "states" in of_episode.deferred.metadata["broken_reason"]
    assert of_episode.is_there


def test_a_full_disk_is_an_error_otherwise(tmp_path: Path) -> None:
    """And all steps before it are there."""
    of_episode = trajectory(tmp_path, tolerated=False)
    with file_size_limit(LIMIT):
        with pytest.raises(FileNotWritten):
            take_steps(of_episode, 12)
        # Nothing more is recorded, which is no error.
        take_steps(of_episode, 1)
        of_episode.end({})
    with open_trajectory(of_episode.path) as reader:
        assert 0 < reader.step_count == of_episode.recorder.steps < 12

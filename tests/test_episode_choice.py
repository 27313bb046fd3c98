# SPDX-License-Identifier: Apache-2.0
"""An episode gets a video and keeps its trajectory as was asked for."""

from __future__ import annotations

from typing import Any

import pytest

from mjrec.recorder.episode_choice import EpisodeChoice
from mjrec.recorder.options import DEFERRED, OFF, RecorderOptions


def choice(*, mode: str = DEFERRED, **options: Any) -> EpisodeChoice:
    return EpisodeChoice(RecorderOptions(**options), mode=mode)


def test_a_schedule_is_asked_once_for_a_number() -> None:
    """Resets before the first step share one."""
    asked = []

    def schedule(episode_id: int) -> bool:
        asked.append(episode_id)
        return episode_id != 1

    chosen = choice(video_callable=schedule)
    assert [chosen.decide(k) for k in (0, 0, 1, 1, 2)] == [True, True, False, False, 1]
    assert asked == [0, 1, 2]


def test_what_was_decided_last_is_known() -> None:
    """Before the first episode nothing was."""
    chosen = choice(video_callable=lambda k: k == 1)
    assert not chosen.is_scheduled
    chosen.decide(1)
    assert chosen.is_scheduled
    chosen.decide(2)
    assert not chosen.is_scheduled


@pytest.mark.parametrize(
    ("mode", "options"),
    [
        (DEFERRED, {"video_callable": False}),
        (DEFERRED, {"step_trigger": lambda steps: True}),
        (OFF, {}),
        (OFF, {"video_callable": lambda k: True}),
    ],
    ids=["asked", "by steps", "off", "off though asked"],
)
def test_no_episode_has_a_video_of_its_own(mode: str, options: Any) -> None:
    """Where none was asked for, where steps begin them, and where none are drawn."""
    chosen = choice(mode=mode, **options)
    assert not chosen.has_videos
    assert not any(chosen.decide(k) for k in range(3))


def test_a_selection_is_the_schedule() -> None:
    """Every episode may be chosen when it has ended, and the manifest says by what."""
    chosen = choice(keep="best:2")
    assert chosen.selection is not None
    assert chosen.has_videos
    assert chosen.decide(5)
    assert chosen.schedule_name == "keep:best:2"
    assert choice().selection is None


@pytest.mark.parametrize(
    ("asked", "episode_type", "expected"),
    [
        # Of episode 3 without a video, of 3 with one, of 4 without one.
        (None, "t", (False, True, False)),
        (None, "e", (True, True, True)),
        (True, "t", (True, True, True)),
        (False, "e", (False, False, False)),
        (lambda episode_id: episode_id == 3, "t", (True, True, False)),
    ],
)
def test_trajectories_are_kept_as_asked(
    asked: Any, episode_type: str, expected: tuple[bool, ...]
) -> None:
    """Of episodes with a video and of evaluations, where nothing was asked."""
    chosen = choice(trajectory_callable=asked)
    found = tuple(
        chosen.keeps_trajectory(k, episode_type=episode_type, has_video=has_video)
        for k, has_video in ((3, False), (3, True), (4, False))
    )
    assert found == expected
    assert all(type(keeps) is bool for keeps in found)


@pytest.mark.parametrize(
    ("options", "episode_type", "stays"),
    [
        ({}, "t", False),
        ({}, "e", True),
        ({"trajectory_callable": True}, "t", True),
    ],
)
def test_a_trajectory_may_be_there_for_its_video_only(
    options: Any, episode_type: str, stays: bool
) -> None:
    """It then goes where the video is not kept."""
    assert choice(**options).keeps_without_video(episode_type) is stays


@pytest.mark.parametrize(
    ("options", "episode_type", "may"),
    [
        ({"video_callable": False}, "t", False),
        ({"video_callable": False}, "e", True),
        ({"video_callable": False, "trajectory_callable": True}, "t", True),
        ({}, "t", True),
    ],
)
def test_whether_there_may_be_a_trajectory_is_known_before(
    options: Any, episode_type: str, may: bool
) -> None:
    """So that nothing is taken down at a reset for nobody."""
    assert choice(**options).may_keep_trajectory(episode_type) is may


def test_trajectories_are_asked_for_once_a_number() -> None:
    """A reset that another one replaces has the same number."""
    numbers: list[int] = []
    chosen = choice(trajectory_callable=lambda number: numbers.append(number) or True)
    for number in (0, 0, 1):
        chosen.keeps_trajectory(number, episode_type="t", has_video=False)
    assert numbers == [0, 1]

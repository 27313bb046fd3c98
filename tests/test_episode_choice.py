# SPDX-License-Identifier: Apache-2.0
"""An episode gets a video and keeps its trajectory as was asked for."""

from __future__ import annotations

from typing import Any

import pytest

from mjrec.recorder.episode_choice import EpisodeChoice
from mjrec.recorder.options import DEFERRED, RecorderOptions


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


def test_trajectories_are_asked_for_once_a_number() -> None:
    """A reset that another one replaces has the same number."""
    numbers: list[int] = []
    chosen = choice(trajectory_callable=lambda number: numbers.append(number) or True)
    for number in (0, 0, 1):
        chosen.keeps_trajectory(number, episode_type="t", has_video=False)
    assert numbers == [0, 1]

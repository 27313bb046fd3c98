# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import doctest
from typing import Any

import numpy as np
import pytest

from mjrec import (
    InvalidArgument,
    capped_cubic_video_schedule,
    disable_videos,
    schedules,
)
from mjrec.schedules import schedule_from_text, schedule_name, to_schedule


def test_cubes_below_1000_and_then_every_1000th() -> None:
    """Below the cap exactly the ten cubes, above it exactly the thousands."""
    chosen = [n for n in range(5000) if capped_cubic_video_schedule(n)]
    assert chosen == [n**3 for n in range(10)] + [1000, 2000, 3000, 4000]


def test_documented_sequence_is_true() -> None:
    """The docstring's example runs."""
    assert doctest.testmod(schedules).failed == 0


def test_schedule_answers_with_a_bool() -> None:
    """Whatever kind of whole number is asked about."""
    assert capped_cubic_video_schedule(np.int64(27)) is True
    assert capped_cubic_video_schedule(np.int32(28)) is False
    assert capped_cubic_video_schedule(-8) is False


def test_disabled_records_nothing() -> None:
    """Not even the first episode."""
    assert not any(disable_videos(n) for n in (0, 1, 8, 1000))


@pytest.mark.parametrize("never", [False, 0, np.False_])
def test_what_equals_false_disables(never: Any) -> None:
    """As in gym."""
    assert to_schedule(never) is disable_videos


def test_none_is_the_cubic_schedule() -> None:
    """And a function is itself."""
    assert to_schedule(None) is capped_cubic_video_schedule
    assert to_schedule(max) is max


@pytest.mark.parametrize("wrong", [True, 1, "cubic", [0, 1], np.array([0, 1])])
def test_other_values_are_an_error(wrong: Any) -> None:
    """The error says what may be given."""
    with pytest.raises(InvalidArgument, match="must be a function"):
        to_schedule(wrong)


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("cubic", [0, 1, 8]),
        ("all", list(range(12))),
        ("none", []),
        ("every:5", [0, 5, 10]),
        ("at:0,5,9", [0, 5, 9]),
    ],
)
def test_schedules_by_name(text: str, chosen: list[int]) -> None:
    """What the command line offers."""
    schedule = schedule_from_text(text)
    assert [n for n in range(12) if schedule(n)] == chosen


@pytest.mark.parametrize(
    "text",
    ["", "cube", "every", "every:", "every:0", "every:x", "at:", "at:-1", "at:a"],
)
def test_unknown_names_are_an_error(text: str) -> None:
    """And nothing is guessed."""
    with pytest.raises(InvalidArgument):
        schedule_from_text(text)


def test_schedule_has_a_name_for_the_manifest() -> None:
    """A function's own, or that of its class; parameters included."""
    assert schedule_name(capped_cubic_video_schedule) == "capped_cubic_video_schedule"
    assert schedule_name(schedule_from_text("every:5")) == "every:5"
    assert schedule_name(schedule_from_text("at:9,0")) == "at:0,9"

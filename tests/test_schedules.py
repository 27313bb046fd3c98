# SPDX-License-Identifier: Apache-2.0
"""Test schedules of recorded episodes."""

import doctest

import numpy as np
import pytest

from mjrec import InvalidArgument, schedules
from mjrec.schedules import schedule_from_text, schedule_name, to_schedule


def test_cubes_below_1000_and_then_every_1000th():
    """The example in the docstring works; the result is a bool for any integer type."""
    chosen = [n for n in range(5000) if schedules.capped_cubic_video_schedule(n)]
    assert chosen == [n**3 for n in range(10)] + [1000, 2000, 3000, 4000]
    assert doctest.testmod(schedules).failed == 0
    assert schedules.capped_cubic_video_schedule(np.int64(27)) is True
    assert schedules.capped_cubic_video_schedule(-8) is False
    # As in gym, None means the default.
    assert to_schedule(None) is schedules.capped_cubic_video_schedule
    assert to_schedule(max) is max
    for never in (False, 0, np.False_):
        assert to_schedule(never) is schedules.disable_videos
    assert not any(schedules.disable_videos(n) for n in (0, 1, 8, 1000))


@pytest.mark.parametrize(
    ("text", "chosen", "name"),
    [
        ("cubic", [0, 1, 8], "capped_cubic_video_schedule"),
        ("all", list(range(12)), None),
        ("none", [], None),
        ("every:5", [0, 5, 10], "every:5"),
        ("at:9,0,5", [0, 5, 9], "at:0,5,9"),
    ],
)
def test_schedules_by_name(text, chosen, name):
    """The name of a schedule in the manifest includes its parameters."""
    schedule = schedule_from_text(text)
    assert [n for n in range(12) if schedule(n)] == chosen
    assert name in (None, schedule_name(schedule))


@pytest.mark.parametrize(
    ("make", "values", "words"),
    [
        (
            to_schedule,
            (True, 1, "cubic", [0, 1], np.array([0, 1])),
            "must be a function",
        ),
        (schedule_from_text, ("", "cube", "every", "every:", "every:0"), None),
        (schedule_from_text, ("every:x", "at:", "at:-1"), None),
    ],
)
def test_other_values_are_an_error(make, values, words):
    for value in values:
        with pytest.raises(InvalidArgument, match=words):
            make(value)

# SPDX-License-Identifier: Apache-2.0
"""Test that `save_video` behaves like Gymnasium's `save_video`."""

import numpy as np
import pytest
from recordings import frames_of

import mjrec
from mjrec.errors import InvalidArgument, UnknownName


def shades(count, made=None):
    """Yield one buffer with growing brightness; list the frame numbers in `made`."""
    buffer = np.empty((16, 16, 3), np.uint8)
    for number in range(count):
        if made is not None:
            made.append(number)
        buffer[:] = 20 + 6 * number
        yield buffer


def shown(path):
    """Return the frame numbers that a video's shades stand for."""
    return [round((frame.mean() - 20) / 6) for frame in frames_of(path)]


def test_default_is_the_capped_cubic_schedule(tmp_path, names):
    for episode in (2, 8, 999, 1000):
        mjrec.save_video(shades(30), tmp_path, fps=30, episode_index=episode)
    assert names(tmp_path) == ["rl-video-episode-1000.mp4", "rl-video-episode-8.mp4"]
    for path in tmp_path.iterdir():
        assert shown(path) == list(range(30))


@pytest.mark.parametrize("kind", ["array", "generator"])
def test_both_triggers_may_be_used(tmp_path, kind):
    """Videos end after `video_length` frames or with the last frame."""
    frames = shades(8)
    if kind == "array":
        frames = np.array([frame.copy() for frame in frames])
    triggers = (lambda _: True, lambda step: step in (1, 5))
    mjrec.save_video(frames, tmp_path, *triggers, video_length=3, fps=30)
    assert shown(tmp_path / "rl-video-episode-0.mp4") == [0, 1, 2]
    assert shown(tmp_path / "rl-video-step-1.mp4") == [2, 3, 4]
    assert shown(tmp_path / "rl-video-step-5.mp4") == [6, 7]


@pytest.mark.parametrize(("length", "count"), [(3, 3), (None, 9), (50, 9)])
def test_generator_makes_only_the_frames_needed(tmp_path, length, count):
    made = []
    options = {"video_length": length, "fps": 30}
    mjrec.save_video(shades(9, made), tmp_path, lambda _: True, **options)
    assert made == shown(tmp_path / "rl-video-episode-0.mp4") == [*range(count)]


def test_frames_before_an_error_are_kept(tmp_path):
    def frames():
        yield from shades(4)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        mjrec.save_video(frames(), tmp_path, fps=30)
    assert shown(tmp_path / "rl-video-episode-0.mp4") == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, InvalidArgument, "needs fps"),
        ({"fps": 30, "duration": 0.1}, UnknownName, r"'duration'.*fps.*crf"),
        ({"fps": 30, "video_length": 0}, InvalidArgument, "video_length"),
    ],
)
def test_options_are_checked_before_the_folder_is_made(
    tmp_path, options, error, message
):
    with pytest.raises(error, match=message):
        mjrec.save_video([*shades(2)], tmp_path / "videos", **options)
    assert not list(tmp_path.iterdir())

# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import numpy as np
import pytest

from mjrec.annotation import Caption, annotated

CAPTION = Caption(episode_id=27, step=120, time=2.4, reward=-35.25)


def plain(height, width, brightness=128):
    return np.full((height, width, 3), brightness, np.uint8)


@pytest.mark.parametrize("size", [(64, 64), (480, 480)])
@pytest.mark.parametrize("brightness", [0, 128, 255])
def test_caption_contrasts_with_any_background(size, brightness):
    """The caption leaves the lower half of the frame unchanged."""
    frame = plain(*size, brightness)
    result = annotated(frame, CAPTION)
    assert (result.shape, result.dtype) == (frame.shape, frame.dtype)
    top, rest = result[: size[0] // 2], result[size[0] // 2 :]
    assert int(top.max()) - int(top.min()) > 140
    np.testing.assert_array_equal(rest, brightness)


@pytest.mark.parametrize(
    "other",
    [{"episode_id": 28}, {"step": 121}, {"time": 2.45}, {"time": None}, {"reward": 1}],
)
def test_caption_shows_every_value(other):
    frame = plain(240, 320)
    before = annotated(frame, CAPTION)
    assert (annotated(frame, replace(CAPTION, **other)) != before).any()


@pytest.mark.parametrize("height", [1, 2, 7, 16, 33])
@pytest.mark.parametrize("width", [1, 7, 33, 700])
def test_any_frame_size_works(height, width):
    """A frame of one pixel has no room for letters and stays unchanged."""
    long = Caption(episode_id=10**9, step=10**9, time=1e9, reward=float("nan"))
    result = annotated(plain(height, width), long)
    assert result.shape == (height, width, 3)
    assert height * width > 1 or (result == 128).all()

# SPDX-License-Identifier: Apache-2.0
"""Videos that show nothing say so."""

import logging

import numpy as np
import pytest
from recordings import frames_of, metadata_of

from mjrec import BlankVideo, VideoRecorder
from mjrec.blank_frames import BlankFrames

SIZE = (40, 56)


def picture(value=0, *, pixel=None):
    """Return a plain picture, with one pixel of another brightness if given."""
    frame = np.full((*SIZE, 3), value, np.uint8)
    if pixel is not None:
        # None that a coarse look would see.
        frame[17, 21] = pixel
    return frame


def facts_of(*frames):
    blank = BlankFrames()
    for frame in frames:
        blank.add(frame)
    return blank.facts()


BLACK = {"suspect_black": True, "suspect_constant": True}
CONSTANT = {"suspect_constant": True}


@pytest.mark.parametrize(
    ("frames", "facts"),
    [
        ([], {}),
        ([picture()], BLACK),
        ([picture(), picture()], BLACK),
        ([picture(pixel=3), picture(4)], {"suspect_black": True}),
        ([picture(90)], CONSTANT),
        ([picture(90), picture(30)], CONSTANT),
        ([picture(90), picture(90, pixel=91)], {}),
        ([picture(90, pixel=0)], {}),
        ([picture(90, pixel=0)] * 3, CONSTANT),
        ([picture(90, pixel=0)] * 2 + [picture(90, pixel=1)], {}),
        ([picture()] * 9 + [picture(pixel=255)], {}),
    ],
)
def test_what_is_suspect(frames, facts):
    """Black, of one colour each, or without movement; one pixel is enough."""
    assert facts_of(*frames) == facts


class Screen:
    """Shows frames that were made before."""

    render_mode = "rgb_array"

    def __init__(self, *frames):
        self.frames = list(frames)

    def render(self):
        return self.frames.pop(0)


def record(path, *frames, strict=False):
    """Return the recorder of a video of these frames; it is not closed."""
    recorder = VideoRecorder(Screen(*frames), path, strict=strict, fps=10)
    for _ in frames:
        recorder.capture_frame()
    return recorder


def test_a_black_live_video_is_a_warning(tmp_path, caplog):
    """Its metadata says it too."""
    recorder = record(tmp_path / "video000000.mp4", picture(), picture())
    with caplog.at_level(logging.WARNING):
        recorder.close()
    assert recorder.metadata.items() >= BLACK.items()
    assert "video000000.mp4 may show nothing: all 2 frames are black" in caplog.text


def test_with_strict_it_is_an_error_and_the_video_is_kept(tmp_path):
    """As evidence, with its metadata."""
    path = tmp_path / "openaigym.video.0.1.video000000.mp4"
    recorder = record(path, picture(80), picture(80), strict=True)
    with pytest.raises(BlankVideo, match="all 2 frames are of a single") as caught:
        recorder.close()
    assert caught.value.path == path
    assert caught.value.frame_count == len(frames_of(path)) == 2
    assert metadata_of(tmp_path, 0)["suspect_constant"] is True
    recorder.close()

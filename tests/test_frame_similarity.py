# SPDX-License-Identifier: Apache-2.0
"""How alike frames are, as an encoder sees them."""

import numpy as np
import pytest

from mjrec.evidence.frame_similarity import (
    OTHER_CPU,
    OTHER_ENCODER,
    OTHER_RENDERER,
    but_for_shadows,
    planes_of,
    similarity,
)
from mjrec.evidence.mp4_videos import decoded_video
from mjrec.formats.video_writer import VideoWriter


def noise(height=48, width=64):
    """Return a frame with everything in it, softened as frames are."""
    random = np.random.default_rng(0)
    small = random.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), np.uint8)
    return np.repeat(np.repeat(small, 4, 0), 4, 1)[:height, :width].copy()


@pytest.mark.parametrize("size", [(48, 64), (33, 47), (1, 1)])
def test_planes_are_those_that_the_encoder_is_given(tmp_path, size):
    """To within a level, against ffmpeg's own conversion without any loss."""
    frame, path = noise(*size), tmp_path / "lossless.mp4"
    with VideoWriter(path, fps=10, crf=0) as video:
        video.write(frame)
    with decoded_video(path) as (_, decoded):
        [shipped] = decoded
    for ours, theirs in zip(planes_of(frame), shipped, strict=True):
        assert ours.shape == theirs.shape
        assert np.abs(ours.astype(int) - theirs).max() <= 1


def test_measures_are_what_their_names_say():
    """Finite for equal frames; PSNR of all planes; structure, not a histogram."""
    planes = planes_of(noise())
    assert similarity(planes, planes) == (100.0, pytest.approx(1.0), 0.0)
    # The mirror image has the same pixels.
    assert similarity(planes, planes_of(noise()[:, ::-1])).ssim < 0.5
    # A level more everywhere is a mean square of one.
    planes = planes_of(np.full((16, 16, 3), 100, np.uint8))
    more = type(planes)(*(plane + 1 for plane in planes))
    assert similarity(planes, more).psnr == pytest.approx(48.13, abs=0.01)
    colour_only = planes._replace(red=planes.red + 1)
    assert similarity(planes, colour_only).psnr == pytest.approx(55.91, abs=0.01)


@pytest.mark.parametrize(("y", "x"), [(0, 0), (20, 20), (22, 30), (47, 63)])
def test_the_worst_block_sees_a_few_pixels_wherever_they_are(y, x):
    """Also where they lie across the blocks' corners or at the frame's edge."""
    frame = np.full((48, 64, 3), 40, np.uint8)
    changed = frame.copy()
    changed[y : y + 4, x : x + 4] = 255
    found = similarity(planes_of(frame), planes_of(changed))
    area = (changed[..., 0] != 40).sum()
    assert found.block >= 0.9 * 185 * np.sqrt(area / 96)


@pytest.mark.parametrize(
    ("limits", "side", "levels"),
    [(OTHER_CPU, 2, 20), (OTHER_ENCODER, 2, 40), (OTHER_RENDERER, 4, 70)],
)
def test_a_change_beyond_the_limits_is_noticed(limits, side, levels):
    """A square of half the contrast, and a patch of so many levels."""
    exact = planes_of(np.full((64, 64, 3), 60, np.uint8))

    def strain(rows, more):
        luma = exact.luma.astype(int)
        luma[rows, rows] += more
        changed = exact._replace(luma=luma.astype(np.uint8))
        return limits.strain(similarity(exact, changed))

    assert strain(slice(11, 11 + side), 110) > 1
    assert strain(slice(0, 16), levels) > 1
    assert strain(slice(11, 12), 40) < 1


def test_a_shadow_is_taken_away_whichever_frame_it_is_in():
    """A patch of any colours that is darker in one frame counts as equal."""
    shaded = noise()
    shaded[8:16, 8:24] //= 4
    lit, shaded = planes_of(noise()), planes_of(shaded)
    for one, other in ((lit, shaded), (shaded, lit)):
        unshadowed, share, patch = but_for_shadows(one, other)
        assert similarity(one, other).block > 50
        assert similarity(one, unshadowed).block < 20
        # A part of it is too dark already to get much darker.
        assert 0.02 < share <= 8 * 16 / (48 * 64)
        assert 0 < patch <= 8 / 48


def test_another_colour_is_no_shadow():
    """Red instead of green stays, however dark."""
    green = np.full((48, 64, 3), (20, 200, 20), np.uint8)
    red = green.copy()
    red[8:16, 8:24] = (90, 10, 10)
    unshadowed, *shares = but_for_shadows(planes_of(green), planes_of(red))
    assert shares == [0, 0]
    assert similarity(planes_of(red), unshadowed).block == 0


@pytest.mark.parametrize(
    ("sides", "patch"), [((4, 60), 0), ((8, 8), 8 / 480), ((30, 30), 30 / 480)]
)
def test_edges_of_shadows_are_no_patch(sides, patch):
    """As thin as they are drawn elsewhere, while a square may hide what it covers."""
    lit = np.full((480, 480, 3), 150, np.uint8)
    shaded = lit.copy()
    shaded[200 : 200 + sides[0], 200 : 200 + sides[1]] = 0
    assert but_for_shadows(planes_of(lit), planes_of(shaded))[2] == patch

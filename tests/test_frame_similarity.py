# SPDX-License-Identifier: Apache-2.0
"""Compare frames in the color planes of the encoder."""

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
    random = np.random.default_rng(0)
    small = random.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), np.uint8)
    return np.repeat(np.repeat(small, 4, 0), 4, 1)[:height, :width].copy()


@pytest.mark.parametrize("size", [(48, 64), (33, 47), (1, 1)])
def test_planes_equal_ffmpegs_own_conversion(tmp_path, size):
    """The planes are within one level of a lossless video."""
    frame, path = noise(*size), tmp_path / "lossless.mp4"
    with VideoWriter(path, fps=10, crf=0) as video:
        video.write(frame)
    with decoded_video(path) as (_, decoded):
        [shipped] = decoded
    for ours, theirs in zip(planes_of(frame), shipped, strict=True):
        assert ours.shape == theirs.shape
        assert np.abs(ours.astype(int) - theirs).max() <= 1


def test_psnr_and_ssim_have_known_values():
    planes = planes_of(noise())
    assert similarity(planes, planes) == (100.0, pytest.approx(1.0), 0.0)
    # A mirror image has the same histogram, but low similarity.
    assert similarity(planes, planes_of(noise()[:, ::-1])).ssim < 0.5
    # A difference of one level everywhere is a mean square error of one.
    planes = planes_of(np.full((16, 16, 3), 100, np.uint8))
    more = type(planes)(*(plane + 1 for plane in planes))
    assert similarity(planes, more).psnr == pytest.approx(48.13, abs=0.01)
    color_only = planes._replace(red=planes.red + 1)
    assert similarity(planes, color_only).psnr == pytest.approx(55.91, abs=0.01)


@pytest.mark.parametrize(("y", "x"), [(0, 0), (20, 20), (22, 30), (47, 63)])
def test_worst_block_notices_few_pixels_anywhere(y, x):
    """Pixels across block corners and at the frame's edge count too."""
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
def test_limits_notice_small_squares_and_patches(limits, side, levels):
    """Limits notice a square of half contrast and a larger patch of fewer levels."""
    exact = planes_of(np.full((64, 64, 3), 60, np.uint8))

    def strain(rows, more):
        luma = exact.luma.astype(int)
        luma[rows, rows] += more
        changed = exact._replace(luma=luma.astype(np.uint8))
        return limits.strain(similarity(exact, changed))

    assert strain(slice(11, 11 + side), 110) > 1
    assert strain(slice(0, 16), levels) > 1
    assert strain(slice(11, 12), 40) < 1


def test_shadow_in_either_frame_is_removed():
    shaded = noise()
    shaded[8:16, 8:24] //= 4
    lit, shaded = planes_of(noise()), planes_of(shaded)
    for one, other in ((lit, shaded), (shaded, lit)):
        unshadowed, share, patch = but_for_shadows(one, other)
        assert similarity(one, other).block > 50
        assert similarity(one, unshadowed).block < 20
        # Dark parts cannot get much darker.
        assert 0.02 < share <= 8 * 16 / (48 * 64)
        assert 0 < patch <= 8 / 48


def test_other_colors_are_no_shadows():
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
    """A thin edge may differ between renderers, but a square may hide something."""
    lit = np.full((480, 480, 3), 150, np.uint8)
    shaded = lit.copy()
    shaded[200 : 200 + sides[0], 200 : 200 + sides[1]] = 0
    assert but_for_shadows(planes_of(lit), planes_of(shaded))[2] == patch

# SPDX-License-Identifier: Apache-2.0
"""How alike pictures are, as an encoder sees them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjrec.evidence.verifying.decoded_video import DecodedVideo
from mjrec.evidence.verifying.difference_picture import difference_picture
from mjrec.evidence.verifying.likeness import OTHER_ENCODER, OTHER_RENDERER, Likeness
from mjrec.evidence.verifying.picture_similarity import (
    but_for_shadows,
    frame_of,
    planes_of,
    similarity,
)
from mjrec.formats.video_writer import VideoWriter


def noise(height: int = 48, width: int = 64) -> Any:
    """Return a picture with everything in it, softened as pictures are."""
    random = np.random.default_rng(0)
    small = random.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), np.uint8)
    return np.repeat(np.repeat(small, 4, 0), 4, 1)[:height, :width].copy()


@pytest.mark.parametrize("size", [(48, 64), (33, 47), (2, 2), (1, 1)])
def test_planes_are_those_that_the_encoder_is_given(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    """To within a level, against ffmpeg's own conversion without any loss."""
    frame = noise(*size)
    path = tmp_path / "lossless.mp4"
    with VideoWriter(path, fps=10, crf=0) as video:
        video.write(frame)
    with DecodedVideo(path) as decoded:
        [shipped] = decoded
    for ours, theirs in zip(planes_of(frame), shipped, strict=True):
        assert ours.shape == theirs.shape
        assert np.abs(ours.astype(int) - theirs).max() <= 1


def test_a_picture_survives_its_planes() -> None:
    """A picture of one colour in each two by two pixels comes back."""
    frame = noise()
    assert np.abs(frame_of(planes_of(frame)).astype(int) - frame).max() <= 3


def test_equal_pictures_are_as_alike_as_can_be() -> None:
    """And their numbers are numbers that JSON can say."""
    planes = planes_of(noise())
    assert similarity(planes, planes) == (100.0, pytest.approx(1.0), 0.0)


def test_psnr_counts_all_three_planes() -> None:
    """A level more everywhere is a mean square of one."""
    planes = planes_of(np.full((16, 16, 3), 100, np.uint8))
    more = type(planes)(*(plane + 1 for plane in planes))
    assert similarity(planes, more).psnr == pytest.approx(48.13, abs=0.01)
    colour_only = planes._replace(red=planes.red + 1)
    assert similarity(planes, colour_only).psnr == pytest.approx(55.91, abs=0.01)


@pytest.mark.parametrize("place", [(0, 0), (20, 20), (22, 30), (44, 60), (47, 63)])
def test_the_worst_block_sees_a_few_pixels_wherever_they_are(
    place: tuple[int, int],
) -> None:
    """Also where they lie across the blocks' corners or at the picture's edge."""
    frame = np.full((48, 64, 3), 40, np.uint8)
    changed = frame.copy()
    changed[place[0] : place[0] + 4, place[1] : place[1] + 4] = 255
    found = similarity(planes_of(frame), planes_of(changed))
    area = changed[..., 0].size - (changed[..., 0] == 40).sum()
    assert found.block >= 0.9 * 185 * np.sqrt(area / 96)


def test_another_structure_lowers_the_structural_similarity() -> None:
    """A picture and its mirror image have the same pixels."""
    frame = noise()
    assert similarity(planes_of(frame), planes_of(frame[:, ::-1])).ssim < 0.5


def test_limits_are_judged_by_the_worst_frame() -> None:
    """One frame beyond them is too much, however good the others are."""
    likeness = Likeness(OTHER_ENCODER)
    planes = planes_of(noise())
    good = similarity(planes, planes)
    assert not likeness.passes
    assert likeness.add(0, good)
    assert likeness.passes
    assert likeness.add(1, good._replace(block=OTHER_ENCODER.block + 1))
    assert not likeness.add(2, good)
    assert (likeness.passes, likeness.worst) == (False, 1)


@pytest.mark.parametrize("limits", [OTHER_ENCODER, OTHER_RENDERER])
def test_what_is_said_to_be_noticed_is_noticed(limits: Any) -> None:
    """A larger square, patch or shift than the stated ones is beyond the limits."""
    frame = np.full((64, 64, 3), 60, np.uint8)
    exact = planes_of(frame)
    likeness = Likeness(limits)
    likeness.add(0, similarity(exact, exact))
    said = likeness.figures()

    def strain(rows: slice, levels: int) -> float:
        luma = exact.luma.astype(int)
        luma[rows, rows] += levels
        changed = exact._replace(luma=luma.astype(np.uint8))
        return limits.strain(similarity(exact, changed))

    side = said["unnoticed_square"] + 1
    assert strain(slice(11, 11 + side), 110) > 1
    assert strain(slice(0, 16), said["unnoticed_patch_levels"] + 1) > 1
    assert strain(slice(None), said["unnoticed_shift_levels"] + 1) > 1
    assert strain(slice(11, 12), 60) < 1


def test_a_difference_is_shown_beside_both_pictures() -> None:
    """Grey where they are equal, bright where the shipped one is brighter."""
    frame = np.full((8, 8, 3), 100, np.uint8)
    brighter = frame + np.uint8(10)
    same = difference_picture(planes_of(frame), planes_of(frame))
    other = difference_picture(planes_of(frame), planes_of(brighter))
    assert same.shape == (8, 3 * 8 + 2 * 4, 3)
    assert (same[:, -8:] == 128).all()
    assert (other[:, -8:] > 190).all()


def test_a_shadow_is_taken_away_whichever_picture_it_is_in() -> None:
    """A patch of any colours that is darker in one picture counts as equal."""
    lit = noise()
    shaded = lit.copy()
    shaded[8:16, 8:24] = shaded[8:16, 8:24] // 4
    for one, other in ((lit, shaded), (shaded, lit)):
        unshadowed, share = but_for_shadows(planes_of(one), planes_of(other))
        assert similarity(planes_of(one), planes_of(other)).block > 50
        assert similarity(planes_of(one), unshadowed).block < 20
        # A part of it is too dark already to get much darker.
        assert 0.02 < share <= 8 * 16 / (48 * 64)


def test_another_colour_is_no_shadow() -> None:
    """Red instead of green stays, however dark."""
    green = np.zeros((48, 64, 3), np.uint8)
    green[...] = (20, 200, 20)
    red = green.copy()
    red[8:16, 8:24] = (90, 10, 10)
    unshadowed, share = but_for_shadows(planes_of(green), planes_of(red))
    assert share == 0
    assert similarity(planes_of(red), unshadowed).block == 0

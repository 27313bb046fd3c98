# SPDX-License-Identifier: Apache-2.0
"""How alike two frames are, seen as an encoder sees them.

Frames are compared as the planes that a video holds: luma, and colour at half the
height and width. Turned back into red, green and blue, a frame without any loss but
that of its colours' resolution would seem as far off as a forged one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..frames import Frame, pad_to_even

# Two frames that are equal have an infinite one, which JSON cannot say.
_BEST_PSNR: Final = 100.0
# In pixels, and the samples of all planes in it.
BLOCK: Final = 8
SAMPLES_OF_BLOCK: Final = BLOCK**2 * 3 // 2
# Of a cell of two by two pixels that is in shadow in one frame only: by how many
# levels its lumas differ at least, and its colours at most from those in shadow.
_LEAST_SHADOW: Final = 12
_SHADOW_COLOUR: Final = 10
# Of the definition of SSIM, for samples of eight bits.
_C1: Final = (0.01 * 255) ** 2
_C2: Final = (0.03 * 255) ** 2

# BT.709, limited range, as the encoder uses it: what red, green and blue weigh, and how
# far each plane reaches.
_RED, _BLUE = 0.2126, 0.0722
_LUMA = np.array([_RED, 1 - _RED - _BLUE, _BLUE], np.float32)
_LUMA_RANGE, _COLOUR_RANGE = 219.0, 224.0


class Planes(NamedTuple):
    """A frame as yuv420p holds it.

    Attributes:
        luma: `(height, width) uint8`.
        blue: the difference from blue, `(height / 2, width / 2) uint8`.
        red: the difference from red, likewise.
    """

    luma: NDArray[np.uint8]
    blue: NDArray[np.uint8]
    red: NDArray[np.uint8]


class Similarity(NamedTuple):
    """How alike two frames are.

    Attributes:
        psnr: peak signal to noise of all samples of the three planes, in dB; 100 where
            they are equal.
        ssim: structural similarity of luma, the mean over blocks of 8 by 8 pixels.
        block: the root mean square of the difference in that block of 8 by 8 pixels in
            which it is largest, in levels of 255. A change of a few pixels moves the
            other two by next to nothing.
    """

    psnr: float
    ssim: float
    block: float


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How far a frame may be from the recreated one.

    Attributes:
        psnr: the least, in dB.
        ssim: the least.
        block: the most, in levels.
        shadow: how much of it may be in shadow in one of the two only, from 0 to 1.
    """

    psnr: float
    ssim: float
    block: float
    shadow: float = 0.0

    def strain(self, found: Similarity) -> float:
        """Return how much of what is allowed was found; more than 1 is too much."""
        noise = 10 ** ((self.psnr - found.psnr) / 20)
        return max(noise, (1 - found.ssim) / (1 - self.ssim), found.block / self.block)


# The same frames through x264 at crf 18: in 23 scenes of dm_control's suite and of
# Gymnasium, from 32x32 to 640x480, the worst frames had 35.7 dB, 0.987 and 11.5 levels
# against the drawn ones. Two encodings of them are apart by at most twice the noise.
# A square of two by two pixels that is painted over has 21 levels or more.
OTHER_ENCODER: Final = Limits(psnr=32.0, ssim=0.97, block=20.0)
# The same rasteriser and ffmpeg on another CPU. llvmpipe draws alike on all that have
# AVX. Without it (128 bits instead of 256) no frame of five videos of six was equal:
# HalfCheetah, Humanoid, Ant, Hopper, Pusher and Swimmer of Gymnasium, from 64x64 to
# 480x480, had 41.7 dB, 0.998 and 9.4 levels at the worst, apart from shadows in 0.14
# per cent of a frame.
OTHER_CPU: Final = Limits(psnr=38.0, ssim=0.985, block=14.0, shadow=0.01)
# Its name says so many bits, and which LLVM built it.
OTHER_BUILD: Final = Limits(psnr=32.0, ssim=0.97, block=20.0, shadow=0.01)
# Another rasteriser besides, in the same scenes: Mesa's softpipe, which smooths no
# edges, against llvmpipe gave 29.3 dB (32x32; 35.5 from 120x160 on), 0.903 and 34
# levels at the worst. An NVIDIA H100 (driver 580.159) against llvmpipe, in 31 videos of
# 23 scenes, gave 31.2 dB, 0.932 and 25 levels, apart from shadows. Five by five pixels
# that are painted over are beyond it, and a frame that is one step off where limbs move
# fast (80 levels), not where they creep.
#
# MuJoCo's shadows of a large floor on itself are a matter of rounding: at 480x480,
# llvmpipe drew patches of them far away in one frame of five of HalfCheetah, 2.1 per
# cent of it, and the H100 none. Without them the same frames had 42.9 dB.
OTHER_RENDERER: Final = Limits(psnr=28.0, ssim=0.88, block=44.0, shadow=0.04)


def planes_of(frame: Frame) -> Planes:
    """Return the planes of a drawn frame, its sides padded to even ones.

    They are those that the encoder is given, to within a level.
    """
    rgb = pad_to_even(frame).astype(np.float32) / 255
    luma = rgb @ _LUMA
    height, width = luma.shape
    # The colours of two by two pixels are their mean.
    quarter = rgb.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
    quarter_luma = quarter @ _LUMA
    blue = (quarter[..., 2] - quarter_luma) / (2 * (1 - _BLUE))
    red = (quarter[..., 0] - quarter_luma) / (2 * (1 - _RED))
    return Planes(
        _levels(16 + _LUMA_RANGE * luma),
        _levels(128 + _COLOUR_RANGE * blue),
        _levels(128 + _COLOUR_RANGE * red),
    )


def similarity(one: Planes, other: Planes) -> Similarity:
    """Return how alike two frames of one size are."""
    squares = [
        np.square(a.astype(np.float32) - b) for a, b in zip(one, other, strict=True)
    ]
    samples = sum(plane.size for plane in squares)
    error = float(sum(plane.sum(dtype=np.float64) for plane in squares)) / samples
    return Similarity(_psnr(error), _ssim(one.luma, other.luma), _block(squares))


def but_for_shadows(one: Planes, other: Planes) -> tuple[Planes, float]:
    """Return `other` with the samples of `one` where only their light differs.

    There either is the other one made darker: the same colour, times a number from
    0 to 1. So a shadow changes it; and so does painting it black.

    Returns:
        The frame, and how much of it is from `one`, from 0 to 1.
    """
    lumas = [_halved(planes.luma) - 16 for planes in (one, other)]
    is_one_lighter = lumas[0] >= lumas[1]
    light, dark = np.maximum(*lumas), np.maximum(np.minimum(*lumas), 0)
    is_shadow = light - dark >= _LEAST_SHADOW
    shade = dark / np.maximum(light, 1)
    for planes in ((one.blue, other.blue), (one.red, other.red)):
        a, b = (plane.astype(np.float32) - 128 for plane in planes)
        lit, shaded = np.where(is_one_lighter, (a, b), (b, a))
        is_shadow &= np.abs(shaded - shade * lit) <= _SHADOW_COLOUR
    of_luma = np.repeat(np.repeat(is_shadow, 2, 0), 2, 1)
    changed = Planes(
        np.where(of_luma, one.luma, other.luma),
        np.where(is_shadow, one.blue, other.blue),
        np.where(is_shadow, one.red, other.red),
    )
    return changed, float(is_shadow.mean())


def _halved(luma: NDArray[np.uint8]) -> NDArray[np.float32]:
    height, width = luma.shape
    cells = luma.reshape(height // 2, 2, width // 2, 2)
    means: NDArray[np.float32] = cells.mean(axis=(1, 3), dtype=np.float32)
    return means


def _psnr(error: float) -> float:
    if not error:
        return _BEST_PSNR
    return min(_BEST_PSNR, 10 * math.log10(255**2 / error))


def _block(squares: list[NDArray[np.float32]]) -> float:
    luma, blue, red = squares
    half = BLOCK // 2
    cells = (
        _blocks(luma, half).sum(axis=(1, 3))
        + _blocks(blue, half // 2).sum(axis=(1, 3))
        + _blocks(red, half // 2).sum(axis=(1, 3))
    )
    # Blocks overlap by half, so that no corner of four of them hides what is small.
    cells = np.pad(cells, ((0, 1), (0, 1)))
    sums = cells[:-1, :-1] + cells[1:, :-1] + cells[:-1, 1:] + cells[1:, 1:]
    return math.sqrt(float(sums.max()) / SAMPLES_OF_BLOCK)


def _ssim(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    a, b = (_blocks(plane.astype(np.float32), BLOCK) for plane in (one, other))
    axes = (1, 3)
    mean_a, mean_b = a.mean(axes), b.mean(axes)
    var_a = np.square(a).mean(axes) - mean_a**2
    var_b = np.square(b).mean(axes) - mean_b**2
    both = (a * b).mean(axes) - mean_a * mean_b
    alike = (2 * mean_a * mean_b + _C1) * (2 * both + _C2)
    scale = (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    return float((alike / scale).mean())


def _blocks(plane: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Return a plane in blocks, its last rows and columns repeated to fill them."""
    height, width = plane.shape
    rows, columns = -(-height // side), -(-width // side)
    padding = (0, rows * side - height), (0, columns * side - width)
    padded = np.pad(plane, padding, mode="edge")
    return padded.reshape(rows, side, columns, side)


def _levels(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    levels: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return levels

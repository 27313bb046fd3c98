# SPDX-License-Identifier: Apache-2.0
"""Similarity of two frames, measured on the planes that an encoder works with.

Frames are compared as the planes that a video holds: luma, and chroma at half the
height and width. If they were converted back to RGB, a frame that has lost only chroma
resolution would seem to differ as much as a forged one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..frames import Frame, pad_to_even

# The PSNR of two equal frames is infinite, which JSON cannot represent.
_BEST_PSNR: Final = 100.0
# Side of a block in pixels, and the number of samples in a block over all planes.
BLOCK: Final = 8
SAMPLES_OF_BLOCK: Final = BLOCK**2 * 3 // 2
# A 2x2 cell counts as shadowed in one frame only if its lumas differ by at least
# _LEAST_SHADOW levels, and its chroma is within _SHADOW_COLOUR levels of the darkened
# one.
_LEAST_SHADOW: Final = 12
_SHADOW_COLOUR: Final = 10
# Where the edge of a shadow is drawn elsewhere, no square of 3x3 such cells is shadowed
# in one frame only: in 18 frames of nine scenes, softpipe against llvmpipe.
_EDGE_CELLS: Final = 2
# The constants in the definition of SSIM, for 8-bit samples.
_C1: Final = (0.01 * 255) ** 2
_C2: Final = (0.03 * 255) ** 2

# BT.709, limited range, as the encoder uses it: the weights of red, green and blue,
# and the range of each plane.
_RED, _BLUE = 0.2126, 0.0722
_LUMA = np.array([_RED, 1 - _RED - _BLUE, _BLUE], np.float32)
_LUMA_RANGE, _COLOUR_RANGE = 219.0, 224.0


class Planes(NamedTuple):
    """The planes of a frame in yuv420p.

    Attributes:
        luma: `(height, width) uint8`.
        blue: the blue difference (Cb), `(height / 2, width / 2) uint8`.
        red: the red difference (Cr), `(height / 2, width / 2) uint8`.
    """

    luma: NDArray[np.uint8]
    blue: NDArray[np.uint8]
    red: NDArray[np.uint8]


class Similarity(NamedTuple):
    """Similarity of two frames.

    Attributes:
        psnr: peak signal-to-noise ratio over all samples of the three planes, in dB;
            100 if the frames are equal.
        ssim: structural similarity of luma, the mean over blocks of 8x8 pixels.
        block: the largest root mean square difference of any block of 8x8 pixels, in
            levels (0 to 255). Changing a few pixels hardly affects PSNR and SSIM.
    """

    psnr: float
    ssim: float
    block: float


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits for the difference between a frame and the recreated one.

    Attributes:
        psnr: the minimum PSNR, in dB.
        ssim: the minimum SSIM.
        block: the maximum block difference, in levels.
        shadow: the maximum share of the frame that may be in shadow in only one of the
            two frames, from 0 to 1.
        patch: the side of the largest square that may be, as a share of the frame's
            shorter side. Squares of 4x4 pixels always may.
    """

    psnr: float
    ssim: float
    block: float
    shadow: float = 0.0
    patch: float = 0.0

    def strain(self, found: Similarity) -> float:
        """Return the difference as a fraction of the limits; more than 1 fails."""
        noise = 10 ** ((self.psnr - found.psnr) / 20)
        return max(noise, (1 - found.ssim) / (1 - self.ssim), found.block / self.block)


# The same frames through x264 at crf 18: in 23 scenes from dm_control's suite and
# Gymnasium, from 32x32 to 640x480, the worst frames had 35.7 dB, 0.987 and 11.5 levels
# against the rendered ones. Two encodings of them differ by at most twice the noise.
# Painting over a square of 2x2 pixels gives 21 levels or more.
OTHER_ENCODER: Final = Limits(psnr=32.0, ssim=0.97, block=20.0)
# The same rasterizer and ffmpeg on a different CPU. llvmpipe renders the same on all
# CPUs with AVX. Without AVX (128 bits instead of 256), five of six videos had no equal
# frame: Gymnasium's HalfCheetah, Humanoid, Ant, Hopper, Pusher and Swimmer, from 64x64
# to 480x480, had 41.7 dB, 0.998 and 9.4 levels at worst, apart from shadows in 0.14
# percent of a frame.
OTHER_CPU: Final = Limits(psnr=38.0, ssim=0.985, block=14.0, shadow=0.01)
# A different build of llvmpipe: its name includes the vector width in bits and the
# version of LLVM.
OTHER_BUILD: Final = Limits(psnr=32.0, ssim=0.97, block=20.0, shadow=0.01)
# A different rasterizer as well, in the same scenes: Mesa's softpipe, which does not
# antialias, against llvmpipe gave 29.3 dB (32x32; 35.5 from 120x160 up), 0.903 and 34
# levels at worst. An NVIDIA H100 (driver 580.159) against llvmpipe, in 31 videos of 23
# scenes, gave 31.2 dB, 0.932 and 25 levels, apart from shadows. These limits detect 5x5
# pixels that are painted over, and a frame that is one step off if limbs move fast (80
# levels), but not if they creep.
#
# Whether a large floor casts shadows on itself in MuJoCo depends on rounding: at
# 480x480, llvmpipe drew patches of them far away in one of five frames of HalfCheetah
# (2.1 percent of the frame, in squares of up to 18 pixels), the H100 none. Without them
# the same frames had 42.9 dB.
OTHER_RENDERER: Final = Limits(
    psnr=28.0, ssim=0.88, block=44.0, shadow=0.03, patch=0.05
)


def planes_of(frame: Frame) -> Planes:
    """Return the planes of a rendered frame, padded to an even width and height.

    The result matches the planes passed to the encoder to within one level.
    """
    rgb = pad_to_even(frame).astype(np.float32) / 255
    luma = rgb @ _LUMA
    height, width = luma.shape
    # The chroma of a 2x2 cell is the mean of its pixels' colors.
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
    """Return the similarity of two frames of the same size."""
    squares = [
        np.square(a.astype(np.float32) - b) for a, b in zip(one, other, strict=True)
    ]
    samples = sum(plane.size for plane in squares)
    error = float(sum(plane.sum(dtype=np.float64) for plane in squares)) / samples
    return Similarity(_psnr(error), _ssim(one.luma, other.luma), _block(squares))


def but_for_shadows(one: Planes, other: Planes) -> tuple[Planes, float, float]:
    """Return `other` with samples of `one` wherever the two differ only in brightness.

    In such places, one frame's color is the other's times a factor from 0 to 1. Shadows
    have this effect, but so does painting pixels black.

    Returns:
        The frame, the share of it that is from `one`, and the side of the largest
        square of that, as a share of the frame's shorter side (see `Limits`).
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
    share, side = float(is_shadow.mean()), 0
    shorter = min(is_shadow.shape)
    while is_shadow.any():
        side += 1
        pairs = is_shadow[1:] & is_shadow[:-1]
        is_shadow = pairs[:, 1:] & pairs[:, :-1]
    return changed, share, side / shorter if side > _EDGE_CELLS else 0.0


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
    # Blocks overlap by half, so that a small change is never split among four blocks.
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
    """Return a plane in blocks; its last rows and columns are repeated to fill them."""
    height, width = plane.shape
    rows, columns = -(-height // side), -(-width // side)
    padding = (0, rows * side - height), (0, columns * side - width)
    padded = np.pad(plane, padding, mode="edge")
    return padded.reshape(rows, side, columns, side)


def _levels(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    levels: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return levels

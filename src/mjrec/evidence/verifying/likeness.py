# SPDX-License-Identifier: Apache-2.0
"""Whether a video's frames are like the pictures drawn, where they cannot be equal.

Another OpenGL driver or graphics card draws a little otherwise, and every encoder
loses a little. How much that may be stands here, as measured; and how large a change
is that nobody would notice by it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from .picture_similarity import SAMPLES_OF_BLOCK, Similarity

# Half of what lies between black and white, in the limited range of a video's luma.
_HALF_CONTRAST: Final = 110.0
# Of three samples two are luma's: what changes luma alone changes so much less.
_LUMA_SHARE: Final = 2 / 3
# How much of a faint patch of 16 by 16 pixels the encoder keeps, measured.
_KEPT: Final = 0.85


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How far a frame may be from what is drawn.

    Attributes:
        psnr: the least, in dB.
        ssim: the least.
        block: the most, in levels.
    """

    psnr: float
    ssim: float
    block: float

    @property
    def mean_square(self) -> float:
        """The most that the mean square of the difference may be, by the PSNR."""
        return 255**2 / 10 ** (self.psnr / 10)

    def strain(self, found: Similarity) -> float:
        """Return how much of what is allowed was found; more than 1 is too much."""
        noise = 10 ** ((self.psnr - found.psnr) / 20)
        return max(noise, (1 - found.ssim) / (1 - self.ssim), found.block / self.block)


# The same pictures through x264 at crf 18: in 23 scenes of dm_control's suite and of
# Gymnasium, from 32x32 to 640x480, the worst frames had 35.7 dB, 0.987 and 11.5 levels;
# which ffmpeg it was, 4.2, 7.0 or 9.0, made no difference to speak of. The PSNR is low
# in small pictures of chequered floors. A square of two by two pixels that is painted
# over has 21 levels or more. The same rasteriser on another CPU differs by no more than
# roundings, and is held to these too.
OTHER_ENCODER: Final = Limits(psnr=34.0, ssim=0.975, block=20.0)
# Another rasteriser besides, in the same scenes: Mesa's softpipe, which smooths no
# edges, against llvmpipe gave 29.3 dB (32x32; 35.5 from 120x160 on), 0.903 and 34
# levels at the worst; llvmpipe held to SSE2 is within a level of itself. An NVIDIA H100
# (driver 580.159) against llvmpipe, in 31 videos of 23 scenes, gave 31.2 dB, 0.932 and
# 25 levels, apart from the shadows below. Five by five pixels that are painted over are
# beyond it, and a frame that is one step off where limbs move fast (80 levels), not
# where they creep.
OTHER_RENDERER: Final = Limits(psnr=28.0, ssim=0.88, block=44.0)
# How much of a frame may be in shadow with one renderer and lit with another. MuJoCo's
# shadows of a large floor on itself are a matter of rounding: at 480x480, llvmpipe drew
# patches of them far away in one frame of five of HalfCheetah and one of ten of Ant
# (108 levels, 27.8 dB), and the H100 none. They took 2.1 per cent of the picture;
# without them the same frames had 42.9 dB, 0.997 and 11 levels.
MOST_SHADOW: Final = 0.04


class Likeness:
    """Is told how alike each frame is, and says at the end what to think of them.

    Args:
        limits: what is allowed.

    Attributes:
        worst: the number of the frame that strains the limits most; None before any.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.worst: int | None = None
        self._worst = Similarity(0.0, 0.0, 0.0)
        self._strain = -1.0
        self._psnrs: list[float] = []
        self._ssims: list[float] = []

    def add(self, number: int, found: Similarity) -> bool:
        """Note a frame, and return whether none before was worse."""
        self._psnrs.append(found.psnr)
        self._ssims.append(found.ssim)
        strain = self.limits.strain(found)
        if strain <= self._strain:
            return False
        self.worst, self._worst, self._strain = number, found, strain
        return True

    @property
    def passes(self) -> bool:
        """Whether every frame is within the limits."""
        return self.worst is not None and self._strain <= 1

    def figures(self) -> dict[str, Any]:
        """Return the numbers, for JSON."""
        square, patch, shift = self._unnoticed()
        return {
            "frames": len(self._psnrs),
            "worst_frame": self.worst,
            "psnr": round(self._worst.psnr, 2),
            "ssim": round(self._worst.ssim, 5),
            "block": round(self._worst.block, 2),
            "median_psnr": round(_median(self._psnrs), 2),
            "median_ssim": round(_median(self._ssims), 5),
            "least_psnr": self.limits.psnr,
            "least_ssim": self.limits.ssim,
            "most_block": self.limits.block,
            "unnoticed_square": square,
            "unnoticed_patch_levels": patch,
            "unnoticed_shift_levels": shift,
        }

    def told(self) -> str:
        """Return how alike the worst frame is, and what was allowed, in words."""
        found, limits = self._worst, self.limits
        return (
            f"the worst of {len(self._psnrs)} frames is {self.worst}: PSNR "
            f"{found.psnr:.1f} dB (at least {limits.psnr:g}), SSIM {found.ssim:.4f} "
            f"(at least {limits.ssim:g}), {found.block:.1f} levels in its worst block "
            f"(at most {limits.block:g})"
        )

    def told_unnoticed(self) -> str:
        """Return the smallest changes that would have been noticed, in words."""
        square, patch, shift = self._unnoticed()
        return (
            f"not noticed would be, in a frame: up to {square}x{square} pixels "
            "changed by half the way from black to white, a small patch by up to "
            f"{patch} of 255 levels, or all pixels by up to {shift}"
        )

    def _unnoticed(self) -> tuple[int, int, int]:
        """Return what could be changed in the worst frame and would pass.

        It follows from the limits, if what was changed was exact before: the side of a
        square, in pixels, that is changed by half the contrast there is; by how many
        levels a patch of a block or more; and by how many all pixels.
        """
        block, room = self.limits.block, self.limits.mean_square
        side = int(math.sqrt(block**2 * SAMPLES_OF_BLOCK) / _HALF_CONTRAST)
        patch = int(block / math.sqrt(_LUMA_SHARE) / _KEPT)
        left = max(0.0, room - 255**2 / 10 ** (self._worst.psnr / 10))
        return side, patch, min(patch, int(math.sqrt(left / _LUMA_SHARE)))


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else 0.0

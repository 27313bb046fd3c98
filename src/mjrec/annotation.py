# SPDX-License-Identifier: Apache-2.0
"""Episode, step, time and return, drawn on a frame.

Pillow draws the letters, in its own font, so that they are the same on every machine
with the same Pillow, in white over a dark band at the frame's top.

Pillow is an extra and is imported when the first frame is annotated.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .errors import MissingDependency
from .frames import Frame

# Of a frame's height, in pixels of letters; and what can still be read.
_LETTERS = 30
_LARGEST_LETTERS = 64
_USUAL_LETTERS = 11
_SMALLEST_LETTERS = 8
# How much of a frame's height the band may take.
_MOST_OF_HEIGHT = 0.5
# Under the band a pixel keeps so much of its brightness, in 256ths.
_LIGHT_UNDER_BAND = 96

_LONG = ("episode ", "step ", "time ", "return ")
_SHORT = ("ep ", "st ", "t ", "R ")
# What a number has room for at least, so that texts rarely move when numbers grow.
_ROOM_LONG = (4, 5, 7, 9)
_ROOM_SHORT = (1, 3, 4, 5)


@dataclass(frozen=True, kw_only=True)
class Caption:
    """What is written on a frame.

    Attributes:
        episode_id: the episode's number.
        step: how many steps were made before the frame.
        time: simulated seconds since the reset; None where unknown.
        reward: the sum of the rewards so far.
    """

    episode_id: int
    step: int
    time: float | None
    reward: float


def annotated(frame: Frame, caption: Caption) -> Frame:
    """Return a frame with a caption on its top.

    The same frame and caption give the same frame, byte for byte, with the same
    Pillow. Letters grow with the frame. In a small one they are abbreviated, stand in
    several lines, or say less; in one of a few pixels there are none.

    Args:
        frame: `(height, width, 3) uint8`; stays as it is.
        caption: what to say.

    Returns:
        A new array of the same size.

    Raises:
        MissingDependency: there is no Pillow that can do it.
    """
    check_annotation()
    # Here, as in `_pillow`.
    from PIL import Image, ImageDraw

    result = np.array(frame, order="C", subok=False)
    texts = _numbers(caption)
    layout = _layout(
        *frame.shape[:2], tuple(-1 if n is None else len(n) for n in texts)
    )
    if layout is None:
        return result
    font = _font(layout.letters)
    written = Image.new("L", (layout.width, layout.height))
    draw = ImageDraw.Draw(written)
    for item, left, bottom in layout.places:
        text = f"{layout.labels[item]}{texts[item]}"
        draw.text((left, bottom), text, fill=255, font=font, anchor="ls")
    band = result[: layout.height]
    np.take(_UNDER_BAND, band, out=band, mode="clip")
    # 255 + 1, so that dividing by 256 leaves all of it.
    cover = np.asarray(written)[:, :, None].astype(np.uint16) + 1
    band[:, : layout.width] += ((255 - band[:, : layout.width]) * cover >> 8).astype(
        np.uint8
    )
    return result


def check_annotation() -> None:
    """Raise an error if frames cannot be annotated here.

    Raises:
        MissingDependency: there is no Pillow, or one that cannot do it.
    """
    _pillow()


def pillow_version() -> str:
    """Return the version of the Pillow that draws the letters.

    Raises:
        MissingDependency: as `check_annotation`.
    """
    return str(_pillow().__version__)


@functools.cache
def _pillow() -> Any:
    try:
        # Here, because it is an extra, and importing stays quick without it.
        import PIL
        from PIL import ImageFont

        # Before 10.1 its font had one size, and without FreeType it has none.
        ImageFont.load_default(size=_USUAL_LETTERS)
    except (ImportError, TypeError) as error:
        raise MissingDependency(
            "Pillow 10.1 or newer, with FreeType",
            purpose="Writing on frames (annotate)",
            install="pip install 'mjrec[annotate]'",
        ) from error
    return PIL


class _Layout(NamedTuple):
    """Where the items of captions stand in frames of one size.

    Attributes:
        height: of the band.
        width: of what is written.
        letters: their size.
        labels: of the items.
        places: item, left and base line of each that there is room for.
    """

    height: int
    width: int
    letters: int
    labels: tuple[str, ...]
    places: tuple[tuple[int, int, int], ...]


# All items in as few lines as fit, then ever fewer of them.
_ARRANGEMENTS = (
    (((0, 1, 2, 3),), ((0, 1), (2, 3)), ((0,), (1,), (2,), (3,))),
    (((0, 1), (3,)), ((0,), (1,), (3,))),
    (((1, 3),), ((1,), (3,))),
    (((1,),),),
)


@functools.lru_cache(maxsize=256)
def _layout(height: int, width: int, lengths: tuple[int, ...]) -> _Layout | None:
    """Return where items of these lengths stand; None where nothing fits.

    Args:
        height: of the frame.
        width: of the frame.
        lengths: of the items' numbers; -1 for one that is left out.
    """
    usual = max(_USUAL_LETTERS, min(_LARGEST_LETTERS, round(height / _LETTERS)))
    for arrangements in _ARRANGEMENTS:
        for labels, room in ((_LONG, _ROOM_LONG), (_SHORT, _ROOM_SHORT)):
            digits = [max(pair) for pair in zip(room, lengths, strict=True)]
            for letters in range(usual, _SMALLEST_LETTERS - 1, -1):
                for lines in arrangements:
                    there = [
                        [item for item in line if lengths[item] >= 0] for line in lines
                    ]
                    layout = _laid_out(
                        list(filter(None, there)), letters, labels, digits
                    )
                    fits = layout.height <= height * _MOST_OF_HEIGHT
                    if fits and layout.width <= width:
                        return layout
    return None


def _laid_out(
    lines: list[list[int]], letters: int, labels: tuple[str, ...], digits: list[int]
) -> _Layout:
    font = _font(letters)
    ascent, descent = font.getmetrics()
    margin = max(1, letters // 3)
    places, widest, top = [], 0, margin // 2
    for line in lines:
        left = margin
        for item in line:
            places.append((item, left, top + ascent))
            text = labels[item] + "0" * digits[item]
            left += math.ceil(font.getlength(text)) + letters
        # Behind the last one there is no gap but the margin.
        widest = max(widest, left - letters + margin)
        top += (ascent + descent) * bool(line)
    return _Layout(top + margin // 2, widest, letters, labels, tuple(places))


def _numbers(caption: Caption) -> tuple[str | None, ...]:
    time, reward = caption.time, caption.reward
    shown = f"{reward:.3f}" if abs(reward) < 1e4 else f"{reward:.1f}"
    if not math.isfinite(reward) or abs(reward) >= 1e7:
        shown = f"{reward:.3g}"
    seconds = None if time is None else f"{time:.2f} s"
    return str(caption.episode_id), str(caption.step), seconds, shown


@functools.lru_cache(maxsize=64)
def _font(letters: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=letters)


_UNDER_BAND = (np.arange(256) * _LIGHT_UNDER_BAND >> 8).astype(np.uint8)

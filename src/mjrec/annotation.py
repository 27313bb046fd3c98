# SPDX-License-Identifier: Apache-2.0
"""Captions drawn on frames: episode, step, time and return.

Pillow draws the text in its built-in font: white letters on a dark band at the top of
the frame. The text looks the same on every machine with the same Pillow version.

Pillow is an optional dependency and is imported when the first frame is annotated.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .errors import MissingDependency
from .frames import Frame

# The default font size is the frame height divided by this, within the limits below.
_LETTERS = 30
_LARGEST_LETTERS = 64
_USUAL_LETTERS = 11
_SMALLEST_LETTERS = 8
# The maximum fraction of a frame's height that the band may take.
_MOST_OF_HEIGHT = 0.5
# The brightness that a pixel keeps under the band, in 256ths.
_LIGHT_UNDER_BAND = 96

_LONG = ("episode ", "step ", "time ", "return ")
_SHORT = ("ep ", "st ", "t ", "R ")
# The minimum width of each number in digits, so that items rarely move as numbers grow.
_ROOM_LONG = (4, 5, 7, 9)
_ROOM_SHORT = (1, 3, 4, 5)


@dataclass(frozen=True, kw_only=True)
class Caption:
    """The values written on a frame.

    Attributes:
        episode_id: the episode's number.
        step: number of steps taken before the frame.
        time: simulated seconds since the reset; None if unknown.
        reward: sum of the rewards so far.
    """

    episode_id: int
    step: int
    time: float | None
    reward: float


def annotated(frame: Frame, caption: Caption) -> Frame:
    """Return a copy of a frame with a caption at the top.

    With the same Pillow version, the same frame and caption always give the same bytes.
    The font size grows with the frame. In a small frame, labels are abbreviated, items
    are spread over several lines, or some items are left out. A frame that is only a
    few pixels in size gets no caption.

    Args:
        frame: `(height, width, 3) uint8`; not modified.
        caption: the values to write.

    Returns:
        A new array of the same size.

    Raises:
        MissingDependency: Pillow is missing, is too old, or lacks FreeType.
    """
    check_annotation()
    # Imported late, see `check_annotation`.
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
    # Adding 1 makes full coverage 256, so that dividing by 256 loses nothing.
    cover = np.asarray(written)[:, :, None].astype(np.uint16) + 1
    band[:, : layout.width] += ((255 - band[:, : layout.width]) * cover >> 8).astype(
        np.uint8
    )
    return result


@functools.cache
def check_annotation() -> str:
    """Return the version of Pillow that draws the captions.

    Raises:
        MissingDependency: Pillow is missing, is too old, or lacks FreeType.
    """
    try:
        # Imported late because Pillow is optional and would slow the import of mjrec.
        import PIL
        from PIL import ImageFont

        # Before 10.1, the font had a fixed size. Without FreeType it cannot be scaled.
        ImageFont.load_default(size=_USUAL_LETTERS)
    except (ImportError, TypeError) as error:
        raise MissingDependency(
            "Pillow 10.1 or newer, with FreeType",
            purpose="Annotating frames (annotate)",
            install="pip install 'mjrec[annotate]'",
        ) from error
    return PIL.__version__


class _Layout(NamedTuple):
    """The layout of a caption for frames of one size.

    Attributes:
        height: the band's height.
        width: the width of the written text.
        letters: the font size.
        labels: the items' labels.
        places: item number, left edge and baseline of each item that fits.
    """

    height: int
    width: int
    letters: int
    labels: tuple[str, ...]
    places: tuple[tuple[int, int, int], ...]


# Arrangements in order of preference: first all items on as few lines as possible,
# then fewer items.
_ARRANGEMENTS = (
    (((0, 1, 2, 3),), ((0, 1), (2, 3)), ((0,), (1,), (2,), (3,))),
    (((0, 1), (3,)), ((0,), (1,), (3,))),
    (((1, 3),), ((1,), (3,))),
    (((1,),),),
)


@functools.lru_cache(maxsize=256)
def _layout(height: int, width: int, lengths: tuple[int, ...]) -> _Layout | None:
    """Return the layout for items of these lengths, or None if nothing fits.

    Args:
        height: the frame's height.
        width: the frame's width.
        lengths: the length of each item's number; -1 for an item that is left out.
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
        # The last item is followed by the margin instead of a gap.
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

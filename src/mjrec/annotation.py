# SPDX-License-Identifier: Apache-2.0
"""Episode, step, time and return, drawn on a frame.

Pillow draws the letters, in its own font, so that they are the same on every machine
with the same Pillow. Each letter is drawn once: a frame is annotated by laying a dark
band over its top and the letters over the band.

Pillow is an extra and is imported when the first frame is annotated.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
        time: simulated seconds since the reset; None where nobody knows.
        reward: the sum of the rewards so far.
    """

    episode_id: int
    step: int
    time: float | None
    reward: float


def annotated(frame: Frame, caption: Caption) -> Frame:
    """Return a frame with a caption on its top.

    The same frame and caption give the same picture, byte for byte, with the same
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
    result = np.array(frame, order="C", subok=False)
    numbers = _numbers(caption)
    layout = _layout(
        *frame.shape[:2], tuple(-1 if n is None else len(n) for n in numbers)
    )
    if layout is None:
        return result
    band = result[: layout.height]
    np.take(_UNDER_BAND, band, out=band, mode="clip")
    _write(band, _mask(layout, numbers))
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


class _Slot(NamedTuple):
    """Where one item of a caption stands.

    Attributes:
        item: which one.
        left: its first column.
        top: its first row.
    """

    item: int
    left: int
    top: int


class _Layout(NamedTuple):
    """Where the items of captions stand in frames of one size.

    Attributes:
        height: of the band.
        width: of what is written.
        letters: their size.
        labels: of the items.
        slots: of the items that there is room for.
    """

    height: int
    width: int
    letters: int
    labels: tuple[str, ...]
    slots: tuple[_Slot, ...]


# All items in as few lines as fit, then ever fewer of them.
_ARRANGEMENTS = (
    (((0, 1, 2, 3),), ((0, 1), (2, 3)), ((0,), (1,), (2,), (3,))),
    (((0, 1), (3,)), ((0,), (1,), (3,))),
    (((1, 3),), ((1,), (3,))),
    (((1,),),),
)


@functools.lru_cache(maxsize=256)
def _layout(height: int, width: int, lengths: tuple[int, ...]) -> _Layout | None:
    """Return where items of so many characters stand; None where nothing fits.

    Args:
        height: of the frame.
        width: of the frame.
        lengths: of the items' numbers; -1 for one that is left out.
    """
    usual = max(_USUAL_LETTERS, min(_LARGEST_LETTERS, round(height / _LETTERS)))
    for arrangements in _ARRANGEMENTS:
        for labels, room in ((_LONG, _ROOM_LONG), (_SHORT, _ROOM_SHORT)):
            for letters in range(usual, _SMALLEST_LETTERS - 1, -1):
                for lines in arrangements:
                    layout = _laid_out(lines, letters, labels, room, lengths)
                    fits = layout.height <= height * _MOST_OF_HEIGHT
                    if fits and layout.width <= width:
                        return layout
    return None


def _laid_out(
    lines: tuple[tuple[int, ...], ...],
    letters: int,
    labels: tuple[str, ...],
    room: tuple[int, ...],
    lengths: tuple[int, ...],
) -> _Layout:
    margin = max(1, letters // 3)
    line_height = _text(" ", letters).shape[0]
    slots, widest, top = [], 0, margin // 2
    for line in lines:
        items = [item for item in line if lengths[item] >= 0]
        left = margin
        for item in items:
            slots.append(_Slot(item, left, top))
            characters = max(room[item], lengths[item])
            left += _text(labels[item], letters).shape[1]
            left += characters * _digit_width(letters) + letters
        # Behind the last one there is no gap but the margin.
        widest = max(widest, left - letters + margin)
        top += line_height * bool(items)
    return _Layout(top + margin // 2, widest, letters, labels, tuple(slots))


def _numbers(caption: Caption) -> tuple[str | None, ...]:
    time = caption.time
    return (
        str(caption.episode_id),
        str(caption.step),
        None if time is None else f"{time:.2f} s",
        _reward(caption.reward),
    )


def _reward(reward: float) -> str:
    if not math.isfinite(reward) or abs(reward) >= 1e7:
        return f"{reward:.3g}"
    return f"{reward:.3f}" if abs(reward) < 1e4 else f"{reward:.1f}"


def _mask(layout: _Layout, numbers: tuple[str | None, ...]) -> NDArray[np.uint8]:
    """Return how much of each pixel of the band the letters cover, of 255."""
    mask = np.zeros((layout.height, layout.width), np.uint8)
    for item, left, top in layout.slots:
        column = left
        for piece in _pieces(layout.labels[item], numbers[item] or "", layout.letters):
            height, width = piece.shape
            mask[top : top + height, column : column + width] = piece
            column += width
    return mask


def _pieces(label: str, number: str, letters: int) -> list[NDArray[np.uint8]]:
    return [_text(label, letters), *(_character(c, letters) for c in number)]


def _write(band: Frame, mask: NDArray[np.uint8]) -> None:
    """Lay white letters over a dark band."""
    part = band[: mask.shape[0], : mask.shape[1]]
    # 255 + 1, so that dividing by 256 leaves all of it.
    cover = mask[:, :, None].astype(np.uint16) + 1
    part += ((255 - part) * cover >> 8).astype(np.uint8)


@functools.lru_cache(maxsize=1024)
def _character(character: str, letters: int) -> NDArray[np.uint8]:
    """Return a character of a number; all digits are of one width."""
    mask = _text(character, letters)
    missing = _digit_width(letters) - mask.shape[1]
    if not character.isdigit() or missing <= 0:
        return mask
    return np.pad(mask, ((0, 0), (missing // 2, missing - missing // 2)))


@functools.lru_cache(maxsize=64)
def _digit_width(letters: int) -> int:
    return max(int(_text(digit, letters).shape[1]) for digit in "0123456789")


@functools.lru_cache(maxsize=1024)
def _text(text: str, letters: int) -> NDArray[np.uint8]:
    """Return how much of each pixel a text covers, of 255; one line high."""
    # Here, as in `_pillow`.
    from PIL import Image, ImageDraw

    font = _font(letters)
    ascent, descent = font.getmetrics()
    size = (math.ceil(font.getlength(text)), ascent + descent)
    image = Image.new("L", size)
    ImageDraw.Draw(image).text((0, ascent), text, fill=255, font=font, anchor="ls")
    return np.asarray(image).copy()


@functools.lru_cache(maxsize=64)
def _font(letters: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=letters)


_UNDER_BAND = (np.arange(256) * _LIGHT_UNDER_BAND >> 8).astype(np.uint8)

# SPDX-License-Identifier: Apache-2.0
"""Film strips for papers: frames of an episode, each with its time.

Frames come from a video, or from a recorded trajectory, which is rerendered and yields
sharper frames of any size. Pillow, an optional package, draws the times. It is imported
only when a strip is created.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from imageio.v3 import imwrite

from ..annotation import check_annotation
from ..atomic_files import replacing, writing
from ..errors import InvalidArgument, UnreadableFile
from ..formats.json_fields import field, integer, list_of, rate, read_object
from ..formats.video_metadata import metadata_path
from ..frames import Frame
from ..rendering import recorded_facts
from ..rendering.jobs import View
from ..rendering.pool import WorkerPool
from .video_stream import frames_at, read_stream, video_kind

_TRAJECTORY: Final = ".h5"
_SIZE: Final = ("height", "width")
_MOST_IN_A_ROW: Final = 8
_DOTS_PER_INCH: Final = 300
# Maximum number of pixels in a strip. At twice this number, Pillow raises an error.
_MOST_PIXELS: Final = 1 << 27

_INK: Final = (32, 32, 32)
# As fractions of a frame's smaller side.
_GAP: Final = 0.03
_LETTERS: Final = 0.09
_SMALLEST_LETTERS: Final = 9
_LARGEST_LETTERS: Final = 96
# As a fraction of the letters' size.
_LINE: Final = 1.25


def film_strip(
    file: str | os.PathLike[str],
    *,
    frames: int = 8,
    columns: int | None = None,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
    quality: str | None = None,
) -> Frame:
    """Return frames of an episode side by side on white, with their times.

    Frames are evenly spaced, including the first and the last. Times are simulated
    seconds since the reset if known, otherwise times in the video.

    Args:
        file: a trajectory (`.h5`), which is rendered, or a video, which is decoded.
        frames: number of frames.
        columns: frames per row. None means up to eight, or several equal rows.
        camera: see `mjrec.render` (trajectories only).
        height: height of each frame in pixels (trajectories only).
        width: width of each frame in pixels (trajectories only).
        quality: `"full"` or `"draft"` (trajectories only).

    Returns:
        `(height, width, 3) uint8`.

    Raises:
        InvalidArgument: there are not enough frames, an argument is invalid, or a
            camera, size or quality was given for a video.
        UnreadableFile: the file is neither a video nor a trajectory, or is damaged.
        MissingDependency: Pillow is not installed.
        EncoderError: the video cannot be decoded.
        NoPictures, UntrustedModel, GLError: see `mjrec.render`.
    """
    path = Path(file)
    _check_count("frames", frames)
    if columns is not None:
        _check_count("columns", columns)
    columns = columns or math.ceil(frames / math.ceil(frames / _MOST_IN_A_ROW))
    check_annotation()
    if path.suffix != _TRAJECTORY:
        if any(option is not None for option in (camera, height, width, quality)):
            raise InvalidArgument(
                f"{path} is a video, so camera, size and quality cannot be changed. To "
                "change them, pass the trajectory instead "
                "(openaigym.trajectory.*.h5)."
            )
        return _laid_out(*_of_video(path, frames), columns)
    with recorded_facts.open_for_rendering(path) as reader:
        recorded_facts.check_has_frames(reader)
        recorded_facts.warn_of_other_frames(path.name, reader.facts)
        indices = _spread(reader.frame_count, frames, path)
        times = [caption.time for caption in recorded_facts.captions(reader, indices)]
    view = View(camera=camera, height=height, width=width, quality=quality)
    with contextlib.closing(WorkerPool(1)) as workers:
        drawn = workers.frames(path, indices, view)
        return _laid_out(drawn, times, columns)


def write_film_strip(path: str | os.PathLike[str], strip: Frame) -> None:
    """Write a film strip as a PNG file with 300 dots per inch.

    Raises:
        InvalidArgument: the name does not end in `.png`.
        FileNotWritten: the disk is full, or the directory does not exist.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InvalidArgument(
            f"A film strip is a PNG file, but {path} does not end in .png. Name it "
            f"{path.with_suffix('.png')}."
        )
    dpi = (_DOTS_PER_INCH, _DOTS_PER_INCH)
    advice = "then run the same command again"
    with writing(path, then=advice), replacing(path) as temporary:
        imwrite(temporary, strip, extension=".png", optimize=True, dpi=dpi)


def _of_video(path: Path, count: int) -> tuple[Iterator[Frame], Sequence[float]]:
    """Return frames of a video, which are decoded lazily, and their times."""
    if video_kind(path) is None:
        raise UnreadableFile(
            path, "it is neither a video (mp4, avi, mkv) nor a trajectory (.h5)"
        )
    stream = read_stream(path)
    indices = _spread(len(stream), count, path)
    times: Sequence[float] = stream.times.tolist()
    height, width = stream.height, stream.width
    with contextlib.suppress(OSError, ValueError):
        metadata = read_object(metadata_path(path))
        # The size before the encoder padded it to even numbers.
        own_height, own_width = (field(metadata, key, integer) for key in _SIZE)
        simulated = _simulated_times(metadata)
        if 0 <= height - own_height <= 1 and 0 <= width - own_width <= 1:
            height, width = own_height, own_width
            times = simulated if len(simulated) == len(stream) else times
    drawn = (frame[:height, :width] for frame in frames_at(stream, indices))
    return drawn, [times[index] for index in indices]


def _simulated_times(metadata: Any) -> Sequence[float]:
    """Return the simulated time of each frame; empty if the metadata has none."""
    if metadata.get("timestep") is None or metadata.get("first_step") is not None:
        return []
    timestep: Fraction = field(metadata, "timestep", rate)
    stride = field(metadata, "stride", integer)
    count = field(metadata, "frame_count", integer)
    runs = field(metadata, "frame_steps", list_of(list_of(integer)))
    if stride < 1 or any(len(run) != 2 for run in runs):
        return []
    steps = itertools.chain.from_iterable(
        range(first, last + 1, stride) for first, last in runs
    )
    # Limited to the number of frames, regardless of the claimed runs.
    known = list(itertools.islice(steps, count + 1))
    return [float(step * timestep) for step in known] if len(known) == count else []


def _spread(available: int, count: int, path: Path) -> list[int]:
    """Return evenly spaced frame numbers, including the first and the last.

    Raises:
        InvalidArgument: the episode has fewer frames.
    """
    if count > available:
        raise InvalidArgument(
            f"{path} has only {available} frames, not {count}. Request at most "
            f"{available} (frames, --frames)."
        )
    return [int(index) for index in np.linspace(0, available - 1, count).round()]


def _check_count(name: str, count: object) -> None:
    is_whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
    if not is_whole or not 1 <= count <= 10_000:  # type: ignore[operator] # see is_whole
        raise InvalidArgument(
            f"{name} must be a whole number from 1 to 10000, got {count!r}."
        )


def _laid_out(
    frames: Iterator[Frame], times: Sequence[float | None], columns: int
) -> Frame:
    """Return an image with rows of frames on white, each with its time below."""
    # Imported here, because Pillow is optional.
    from PIL import Image, ImageDraw, ImageFont

    first = next(frames)
    height, width = first.shape[:2]
    columns = min(columns, len(times))
    rows = math.ceil(len(times) / columns)
    gap = max(2, round(_GAP * min(height, width)))
    labels = _labels(times)
    letters = round(_LETTERS * min(height, width))
    letters = max(_SMALLEST_LETTERS, min(_LARGEST_LETTERS, letters))
    font = ImageFont.load_default(size=letters)
    while max(map(font.getlength, labels)) > width and letters > 1:
        letters -= 1
        font = ImageFont.load_default(size=letters)
    below = gap // 2 + math.ceil(_LINE * letters) if any(labels) else 0
    size = gap + columns * (width + gap), gap + rows * (height + below + gap)
    if size[0] * size[1] > _MOST_PIXELS:
        raise InvalidArgument(
            f"The strip would have {size[0]}x{size[1]} pixels. Request fewer or "
            "smaller frames (frames, size)."
        )
    paper = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(paper)
    shown = itertools.chain([first], frames)
    for number, (frame, label) in enumerate(zip(shown, labels, strict=True)):
        row, column = divmod(number, columns)
        left, top = gap + column * (width + gap), gap + row * (height + below + gap)
        paper.paste(Image.fromarray(frame), (left, top))
        middle = left + width / 2, top + height + gap // 2
        draw.text(middle, label, fill=_INK, font=font, anchor="ma")
    return np.array(paper)


def _labels(seconds: Sequence[float | None]) -> list[str]:
    """Return the times as strings with enough digits to distinguish them."""
    known = [time for time in seconds if time is not None]
    steps = [b - a for a, b in itertools.pairwise(known) if b > a]
    digits = 2
    while digits < 6 and steps and min(steps) < 2 * 10.0**-digits:
        digits += 1
    return ["" if time is None else f"{time:.{digits}f} s" for time in seconds]

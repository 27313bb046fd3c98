# SPDX-License-Identifier: Apache-2.0
"""From the frames of an episode to videos of it, in one call."""

from __future__ import annotations

import inspect
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DirectoryNotWritable, InvalidArgument, UnknownName
from ..frames import Frame
from ..rates import to_rate
from ..schedules import capped_cubic_video_schedule
from .video_writer import VideoWriter


def save_video(
    frames: Iterable[Frame],
    video_folder: str | os.PathLike[str],
    episode_trigger: Callable[[int], Any] | None = None,
    step_trigger: Callable[[int], Any] | None = None,
    video_length: int | None = None,
    name_prefix: str = "rl-video",
    episode_index: int = 0,
    step_starting_index: int = 0,
    **kwargs: Any,
) -> None:
    """Write videos of one episode's frames, as Gymnasium's function of that name does.

    `<prefix>-episode-<episode_index>.mp4` holds the episode, if `episode_trigger` says
    yes; `<prefix>-step-<n>.mp4` begins with the frame of step n, for each n for which
    `step_trigger` says yes. The first frame is the reset's and belongs to no step; the
    second is that of step `step_starting_index`. Every frame is in the file.

    `frames` may be any iterable. Where only the episode trigger is used it is streamed,
    read no further than `video_length`, and not at all when no video is due; with a
    step trigger, whose videos may overlap, all frames are held in memory. An existing
    video is replaced when the new one is complete. No frames, no file. If `frames`
    raises, the frames before that are kept.

    Args:
        frames: `(height, width, 3) uint8` arrays.
        video_folder: the directory; made if need be.
        episode_trigger: from an episode's number to whether it gets a video. If both
            triggers are None: the cubes 0, 1, 8, 27 ... 729 and every 1000th.
        step_trigger: from a step's number to whether a video begins there.
        video_length: the most frames of a video; all that follow if None.
        name_prefix: begins the files' names.
        episode_index: the episode's number.
        step_starting_index: the number of the episode's first step.
        **kwargs: `fps`, which is required, and the other options of `VideoWriter`.

    Raises:
        InvalidArgument: `fps` is missing, an option is unknown, or a value cannot be.
        DirectoryNotWritable: `video_folder` cannot be made or written to.
        InvalidFrame: what is no picture.
        EncoderError: as `VideoWriter.write` and `close`.
    """
    _check_options(kwargs)
    _check_video_length(video_length)
    if episode_trigger is None and step_trigger is None:
        episode_trigger = capped_cubic_video_schedule
    folder = Path(video_folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(folder, error) from error
    if step_trigger is not None:
        # Copies: a generator may fill the same array again and again.
        is_held = isinstance(frames, Sequence | np.ndarray)
        frames = held = list(frames if is_held else map(np.array, frames))
    if episode_trigger is not None and episode_trigger(episode_index):
        path = folder / f"{name_prefix}-episode-{episode_index}.mp4"
        _write_video(itertools.islice(frames, video_length), path, kwargs)
    if step_trigger is not None:
        # The first frame is the reset's.
        for step, first in enumerate(range(1, len(held)), start=step_starting_index):
            if step_trigger(step):
                last = None if video_length is None else first + video_length
                path = folder / f"{name_prefix}-step-{step}.mp4"
                _write_video(held[first:last], path, kwargs)


def _write_video(frames: Iterable[Frame], path: Path, options: dict[str, Any]) -> None:
    with VideoWriter(path, **options) as video:
        for frame in frames:
            video.write(frame)


def _check_options(options: dict[str, Any]) -> None:
    parameters = inspect.signature(VideoWriter).parameters.values()
    known = [one.name for one in parameters if one.kind is one.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            raise UnknownName("option of save_video", name, known)
    if "fps" not in options:
        raise InvalidArgument(
            "save_video needs fps, the frames per second of the video: "
            "fps=env.metadata['render_fps'], for example."
        )
    to_rate(options["fps"])


def _check_video_length(video_length: object) -> None:
    if video_length is None:
        return
    is_number = isinstance(video_length, int) and not isinstance(video_length, bool)
    if not is_number or not video_length > 0:  # type: ignore[operator]  # is_number
        raise InvalidArgument(
            "video_length must be a positive number of frames, or None for all, got "
            f"{video_length!r}."
        )

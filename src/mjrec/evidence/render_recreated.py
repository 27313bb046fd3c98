# SPDX-License-Identifier: Apache-2.0
"""Rendering the videos of a recreated run: all of them, or a sample of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np

from ..errors import Error
from ..formats.trajectory_file import open_trajectory
from ..rendering.jobs import View
from ..rendering.pool import WorkerPool
from ..rendering.recordings import look_at, recordings
from ..rendering.render_videos import render_videos

_OnProgress = Callable[[int, int], object]


def draw_all(directory: Path, on_progress: _OnProgress) -> None:
    """Render and encode all pending videos of a directory.

    Raises:
        Error: a video could not be rendered.
    """
    rendered = render_videos(
        directory,
        on_progress=lambda now: on_progress(now.frames_done, now.frames or 0),
    )
    for name, reason in rendered.failures.items():
        raise Error(f"The video {name} could not be rendered: {reason}")


def draw_sample(
    directory: Path, into: Path, *, count: int, seed: int, on_progress: _OnProgress
) -> None:
    """Render a sample of the frames of each pending video, as images.

    Clips, annotated videos and tiled videos are skipped.

    Args:
        directory: the directory of the recordings.
        into: a new folder for the frames, `<video>/<number>.png`.
        count: maximum number of frames per video.
        seed: the seed of the random choice of frames.
        on_progress: called with the number of frames rendered so far and in total.

    Raises:
        Error: a frame could not be rendered.
    """
    chosen = np.random.default_rng(seed)
    videos = list(_pending(directory))
    done = 0
    with WorkerPool(1) as pool:
        for name, trajectory, total, camera in videos:
            picked = chosen.choice(total, min(count, total), replace=False)
            numbers = sorted(map(int, picked))
            folder = into / name
            folder.mkdir(parents=True)
            try:
                frames = pool.frames(trajectory, numbers, View(camera=camera))
                for number, frame in zip(numbers, frames, strict=True):
                    imageio.v3.imwrite(folder / f"{number}.png", frame)
                    done += 1
                    on_progress(done, count * len(videos))
            except Error as error:
                raise Error(
                    f"The video {name} could not be rendered: {error}"
                ) from error


def _pending(directory: Path) -> Iterator[tuple[str, Path, int, Any]]:
    """Yield the name, trajectory, number of frames and camera of each pending video."""
    for key in recordings(directory):
        plan = None if key.is_clip else look_at(directory, key)
        if plan is None:
            continue
        [trajectory] = plan.parts
        with open_trajectory(trajectory) as reader:
            video_facts: Mapping[str, Any] = reader.facts.get("video") or {}
            count = reader.frame_count
        if video_facts.get("annotate") or video_facts.get("tiled"):
            continue
        cameras = [None, *video_facts.get("cameras", ())[1:]]
        for video, camera in zip(plan.videos, cameras, strict=True):
            yield video.name, trajectory, count, camera

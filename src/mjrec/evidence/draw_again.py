# SPDX-License-Identifier: Apache-2.0
"""Drawing the videos of a run that was recreated: all of them, or some frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np

from ..errors import Error
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import (
    further_parts,
    is_manifest,
    iter_monitor_files,
    with_part,
)
from ..formats.trajectory_file import open_trajectory
from ..rendering.pool import WorkerPool
from ..rendering.render_videos import render_videos
from ..rendering.views import View

_OnProgress = Callable[[int, int], object]


def draw_all(directory: Path, on_progress: _OnProgress) -> None:
    """Draw and encode all pending videos of a directory.

    Raises:
        Error: one could not be.
    """
    rendered = render_videos(
        directory,
        on_progress=lambda now: on_progress(now.frames_done, now.frames or 0),
    )
    for name, reason in rendered.failures.items():
        raise Error(f"The video {name} could not be drawn: {reason}")


def draw_sample(
    directory: Path, into: Path, *, count: int, seed: int, on_progress: _OnProgress
) -> None:
    """Draw some frames of each pending video, as images by their numbers.

    Of clips, of frames with text on them and of tiled videos none is drawn.

    Args:
        directory: the recordings.
        into: a new folder; `<video>/<number>.png` in it are the frames.
        count: how many of each video.
        seed: of the choice.
        on_progress: told how many frames are drawn, and of how many.

    Raises:
        Error: one could not be drawn.
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
                raise Error(f"The video {name} could not be drawn: {error}") from error


def _pending(directory: Path) -> Iterator[tuple[str, Path, int, Any]]:
    """Yield names of videos, what each is drawn from, how many frames, its camera."""
    for path in iter_monitor_files(directory):
        if not is_manifest(path.name):
            continue
        for entry in (read_manifest(path).mjrec or {}).get("pending", ()):
            if "clip" in entry:
                continue
            trajectory = directory / f"{entry['trajectory']}.h5"
            with open_trajectory(trajectory) as reader:
                promise: Mapping[str, Any] = reader.facts.get("video") or {}
                count = reader.frame_count
            if promise.get("annotate") or promise.get("tiled"):
                continue
            yield entry["video"], trajectory, count, None
            cameras = promise.get("cameras", ())
            parts = further_parts(cameras)
            for part, camera in zip(parts, cameras[1:], strict=False):
                yield with_part(entry["video"], part), trajectory, count, camera

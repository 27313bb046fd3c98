# SPDX-License-Identifier: Apache-2.0
"""The speed of `mjrec.VideoWriter`, and the time that its `close` takes."""

from __future__ import annotations

import functools
import statistics
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjrec import VideoWriter
from mjrec.frames import Frame

from .children import call
from .results import Result
from .rounds import Say, take_turns

TITLE = "Encoding: frames per second of VideoWriter, including close()"

_VARIANTS: Mapping[str, dict[str, Any]] = {
    "default": {},
    "frame_hashes": {"frame_hashes": True},
    "codec=libx264rgb": {"codec": "libx264rgb"},
    "codec=ffv1": {"codec": "ffv1"},
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        frames: number of frames that each variant writes in a round.
        size: height and width of the frames.
    """

    rounds: int = 5
    frames: int = 200
    size: tuple[int, int] = (480, 480)


FULL = Settings()
QUICK = Settings(rounds=3, frames=100)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a result line for each set of encoding options."""
    height, width = settings.size
    samples = take_turns(
        {
            name: functools.partial(
                call,
                write_video,
                frames=settings.frames,
                height=height,
                width=width,
                options=options,
            )
            for name, options in _VARIANTS.items()
        },
        rounds=settings.rounds,
        say=say,
    )
    subject = f"gradients with noise, {width}x{height}"
    return [_result(subject, name, values) for name, values in samples.items()]


def write_video(
    frames: int, height: int, width: int, options: dict[str, Any]
) -> dict[str, float]:
    """Write frames to a video, and return the speed and the size of the file."""
    gradients = moving_gradients(frames, height, width)
    with tempfile.TemporaryDirectory() as directory:
        # The first close in a process also reads the whole ffmpeg binary to hash it.
        _write(gradients[:2], Path(directory) / "first.mkv", options)
        return _write(gradients, Path(directory) / "second.mkv", options)


def moving_gradients(count: int, height: int, width: int) -> Frame:
    """Return frames with moving gradients and noise that resembles textures."""
    y, x = np.mgrid[0:height, 0:width]
    base = np.stack([x, y, (x + y) // 2], axis=-1) % 256
    noise = np.random.default_rng(0).integers(0, 8, base.shape)
    frames = [np.roll(base, 3 * number, axis=1) + noise for number in range(count)]
    return np.clip(frames, 0, 255).astype(np.uint8)


def _write(frames: Frame, path: Path, options: dict[str, Any]) -> dict[str, float]:
    video = VideoWriter(path, fps=40, **options)
    start = time.perf_counter()
    for frame in frames:
        video.write(frame)
    written = time.perf_counter()
    video.close()
    closed = time.perf_counter()
    count = len(frames)
    return {
        "rate": count / (closed - start),
        "closing": closed - written,
        "frame_bytes": video.path.stat().st_size / count,
    }


def _result(subject: str, name: str, samples: list[dict[str, float]]) -> Result:
    closing = statistics.median(sample["closing"] for sample in samples)
    size = statistics.median(sample["frame_bytes"] for sample in samples)
    return Result(
        subject=subject,
        variant=name,
        unit="frames/s",
        samples=tuple(sample["rate"] for sample in samples),
        note=f"close() {closing:.2f} s, {size / 1000:.1f} kB per frame",
    )

# SPDX-License-Identifier: Apache-2.0
"""How fast `VideoWriter` is, and how long `close` takes.

`python benchmarks/video_writer.py [FRAMES.npy]`, where the file holds a
`(frames, height, width, 3) uint8` array; without it, moving gradients with noise.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjrec import VideoWriter
from mjrec.frames import Frame


def moving_gradients(count: int, height: int, width: int) -> Frame:
    """Return pictures that move, with the noise that textures have."""
    y, x = np.mgrid[0:height, 0:width]
    base = np.stack([x, y, (x + y) // 2], axis=-1) % 256
    noise = np.random.default_rng(0).integers(0, 8, base.shape)
    frames = [np.roll(base, 3 * number, axis=1) + noise for number in range(count)]
    return np.clip(frames, 0, 255).astype(np.uint8)


def measure(frames: Frame, **options: Any) -> str:
    """Write the frames to a temporary file and say how fast that was."""
    with tempfile.TemporaryDirectory() as directory:
        video = VideoWriter(Path(directory) / "a.mkv", fps=40, **options)
        start = time.perf_counter()
        for frame in frames:
            video.write(frame)
        written = time.perf_counter()
        video.close()
        closed = time.perf_counter()
        size = video.path.stat().st_size
    count = len(frames)
    return (
        f"write {count / (written - start):6.0f} frames/s, "
        f"in all {count / (closed - start):6.0f} frames/s, "
        f"close {closed - written:5.2f} s, {size / count / 1000:6.1f} kB/frame"
    )


def main() -> None:
    """Measure the defaults, with frame hashes, and two lossless codecs."""
    frames = np.load(sys.argv[1]) if sys.argv[1:] else moving_gradients(200, 480, 480)
    print(f"{len(frames)} frames of (height, width) {frames.shape[1:3]}")
    # The first close of a process also reads the whole ffmpeg binary for its sha256.
    print(f"first            {measure(frames[:20])}")
    for options in (
        {},
        {"frame_hashes": True},
        {"codec": "libx264rgb"},
        {"codec": "ffv1"},
    ):
        name = ", ".join(f"{key}={value}" for key, value in options.items())
        print(f"{name or 'default':<16} {measure(frames, **options)}")


if __name__ == "__main__":
    main()

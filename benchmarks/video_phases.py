# SPDX-License-Identifier: Apache-2.0
"""The time of each phase of a video.

Run `python -m benchmarks --only time_to_video --phases`. The phases run one after
another, with the same functions that a recording uses. In a recording, some phases run
at the same time. The phases are the same with and without a GPU.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import mjrec
from mjrec.child_python import Child
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.video_file import content_facts
from mjrec.rendering.jobs import View
from mjrec.rendering.worker import trajectory_drawing
from mjrec.simulation.renderer import Canvas

from .children import call
from .results import Result
from .rounds import Say, take_turns
from .setups import MONITOR, UNENDING, Setup, random_actions
from .time_to_video import FULL, QUICK, Settings

TITLE = "Time to video, phase by phase"
# FULL and QUICK are those of `time_to_video`, so the episodes are the same.
__all__ = ["FULL", "QUICK", "TITLE", "measure"]

# The size of the pipes that `child_python` creates.
_PIPE_BYTES = 1 << 20

# The phases, in the order in which a recording runs them.
_PARTS = {
    "process beside the simulation": "Python and all imports, once per monitor",
    "OpenGL context": "once per worker",
    "reset and steps": "including saving the state of each step",
    "trajectory": "rows to HDF5, compressed",
    "model to the driver": "loading, textures, shadow map; once per worker",
    "drawing": "mjr_render of all frames, by one worker",
    "reading back": "mjr_readPixels of all frames, by one worker",
    "pipe": "reading and hashing frames from a worker's pipe",
    "x264": "hashing, ffmpeg and its pipe",
    "check": "decoding the finished file, counting and hashing its frames",
}


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a result line for each phase of the videos in `time_to_video`."""
    case, steps = settings.cases[0], settings.steps[0]
    height, width = settings.size
    samples = take_turns(
        {
            quality: functools.partial(
                call,
                seconds_of_parts,
                env_id=case.env_id,
                steps=steps,
                height=height,
                width=width,
                quality=quality,
            )
            for quality in ("full", "draft")
        },
        rounds=settings.rounds,
        say=say,
    )
    return [
        Result(
            subject=f"{case.env_id}, {steps} steps, {width}x{height}, {quality}",
            variant=part,
            unit="s",
            samples=tuple(found[part] for found in rounds),
            note=_PARTS[part],
        )
        for quality, rounds in samples.items()
        for part in _PARTS
    ]


def seconds_of_parts(
    env_id: str, steps: int, height: int, width: int, quality: str
) -> Mapping[str, float]:
    """Return the seconds that each phase takes for one episode."""
    parts: dict[str, float] = {}

    def timed(part: str, do: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        try:
            return do()
        finally:
            parts[part] = time.perf_counter() - start

    with tempfile.TemporaryDirectory() as directory:
        timed("process beside the simulation", lambda: _begin_process(directory))
        setup = Setup(
            env_id=env_id,
            recorder=MONITOR,
            make={
                **UNENDING.get(env_id, {}),
                "height": height,
                "width": width,
                "max_episode_steps": steps,
            },
            options={"quality": quality, "workers": 0},
        )
        env = setup.open(directory)
        actions = random_actions(env, steps)

        def run() -> None:
            env.reset(seed=0)
            for action in actions:
                env.step(action)

        timed("reset and steps", run)
        timed("trajectory", env.close)
        [trajectory] = Path(directory).glob("*.h5")
        frames = _draw(timed, trajectory, parts)
        timed("pipe", lambda: _through_pipe(frames))
        path = Path(directory) / "video.mp4"
        timed("x264", lambda: _encode(frames, path))
        # The time for `_encode` includes a check of the file, so it is subtracted.
        even = (height + height % 2, width + width % 2)
        timed(
            "check",
            lambda: content_facts(
                path, height=even[0], width=even[1], pixel_format="yuv420p"
            ),
        )
        parts["x264"] -= parts["check"]
    return parts


def _encode(frames: list[Any], path: Path) -> None:
    with mjrec.VideoWriter(path, fps=20, frame_hashes=True) as video:
        for frame in frames:
            video.write(frame)


def _begin_process(directory: str) -> None:
    """Start the rendering process and wait until it is ready for a recording."""
    options = json.dumps({"directory": directory, "workers": 1, "strict": False})
    module = "mjrec.rendering.background"
    with Child(module, options, environ=os.environ) as child:
        # This recording does not exist, so the answer is that there is nothing to do.
        child.send(recording="openaigym.trajectory.0.1.episode000000.h5")
        for message in child.messages(60):
            if message is not None and "done" in message:
                return
    raise RuntimeError("The rendering process did not start.")


def _draw(
    timed: Callable[[str, Callable[[], Any]], Any],
    trajectory: Path,
    parts: dict[str, float],
) -> list[Any]:
    """Draw all frames as a worker does, and return them."""
    canvas = Canvas(is_alone=True)
    timed("OpenGL context", canvas.open)
    drawing = timed(
        "model to the driver",
        lambda: trajectory_drawing(trajectory, View(), canvas=canvas),
    )
    parts["reading back"] = 0.0
    read = mujoco.mjr_readPixels

    def read_pixels(*arguments: Any) -> None:
        start = time.perf_counter()
        read(*arguments)
        parts["reading back"] += time.perf_counter() - start

    mujoco.mjr_readPixels = read_pixels
    with open_trajectory(trajectory) as reader:
        count = reader.frame_count
    try:
        frames: list[Any] = timed(
            "drawing", lambda: [drawing.draw(index) for index in range(count)]
        )
    finally:
        mujoco.mjr_readPixels = read
        drawing.close()
        canvas.close()
    parts["drawing"] -= parts["reading back"]
    return frames


def _through_pipe(frames: list[Any]) -> None:
    """Send frames through a pipe as large as a worker's, and hash the output."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def send() -> None:
        for frame in frames:
            view = memoryview(frame).cast("B")
            while view:
                view = view[os.write(writing, view) :]

    sender = threading.Thread(target=send)
    sender.start()
    received = np.empty_like(frames[0])
    for _ in frames:
        view = memoryview(received).cast("B")
        while view:
            view = view[os.readv(reading, [view]) :]
        hashlib.sha256(received.data).digest()
    sender.join()
    os.close(reading)
    os.close(writing)

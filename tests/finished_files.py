# SPDX-License-Identifier: Apache-2.0
"""Finished recordings as trackers receive them."""

import time
import types

import mjrec
from mjrec.trackers import FinishedEpisode, FinishedVideo, Run


def episode(number=0, **facts):
    """Return an episode of ten steps after others of ten steps."""
    now = time.time()
    usual = {
        "episode_id": number,
        "length": 10,
        "reward": 1.5 * number,
        "type": "t",
        "terminated": True,
        "truncated": False,
        "success": None,
        "seed": None,
        "options": None,
        "start_time": now - 1,
        "end_time": now,
        "total_steps": 10 * (number + 1),
    }
    return FinishedEpisode(**{**usual, **facts})


def record(directory, env, play):
    """Record an episode; return its run and its video."""
    options = {"video_callable": lambda n: n == 0, "env_id": "Corridor-v0"}
    with mjrec.Monitor(env, directory, **options) as monitor:
        play(monitor, 1)
    [path] = directory.glob("*.mp4")
    metadata = path.with_suffix(".meta.json")
    video = FinishedVideo(
        path=path, metadata_path=metadata, episode_id=0, episode=episode()
    )
    run = Run(directory=directory, infix="0.4711", env_id="Corridor-v0")
    return types.SimpleNamespace(run=run, video=video)

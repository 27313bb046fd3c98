# SPDX-License-Identifier: Apache-2.0
"""Finished recordings, and what a tracker is told of them."""

from __future__ import annotations

import time
from dataclasses import dataclass

import mjrec
from mjrec.trackers import FinishedEpisode, FinishedVideo, Run


@dataclass(frozen=True)
class Finished:
    """A recording of one episode."""

    run: Run
    video: FinishedVideo


def episode(number=0, **facts):
    """Return an episode of ten steps; the run had no others."""
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
    """Record an episode, and return it with its video."""
    with mjrec.Monitor(
        env, directory, video_callable=lambda n: n == 0, env_id="Corridor-v0"
    ) as monitor:
        play(monitor, 1)
    [path] = directory.glob("*.mp4")
    return Finished(
        run=Run(directory=directory, infix="0.4711", env_id="Corridor-v0"),
        video=FinishedVideo(
            path=path,
            metadata_path=path.with_suffix(".meta.json"),
            episode_id=0,
            episode=episode(),
        ),
    )

# SPDX-License-Identifier: Apache-2.0
"""Who wants to be told of finished episodes and videos: experiment trackers.

A tracker is called in the process of the simulation, between two steps, and so should
be quick. It is given facts and names of files, never pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Run:
    """One monitor's recording.

    Attributes:
        directory: the monitor directory, absolute.
        infix: what the names of its files have in the middle.
        env_id: the environment's name.
        env_index: which sub-environment of a vector environment it is, from 0; None
            for an environment of its own.
    """

    directory: Path
    infix: str
    env_id: str
    env_index: int | None = None


@dataclass(frozen=True, kw_only=True)
class FinishedEpisode:
    """An episode that is over.

    Attributes:
        episode_id: its number.
        length: number of steps.
        reward: sum of the rewards.
        type: `"t"` for training, `"e"` for evaluation.
        terminated: the task ended it.
        truncated: a limit from outside the task ended it.
        success: what the environment says of it, `info["is_success"]` or
            `info["success"]` of the last step; None where it says nothing.
        seed: as given to `reset`.
        options: as given to `reset`.
        start_time: wall clock just before the reset, in seconds since the epoch.
        end_time: wall clock after the last step.
        total_steps: the steps of the run so far, those of unfinished episodes too.
    """

    episode_id: int
    length: int
    reward: float
    type: str
    terminated: bool
    truncated: bool
    success: bool | None
    seed: Any
    options: Any
    start_time: float
    end_time: float
    total_steps: int


@dataclass(frozen=True, kw_only=True)
class FinishedVideo:
    """A video that is there, whole.

    Attributes:
        path: the file.
        metadata_path: all about it, JSON.
        episode_id: of its episode, or of the one in which it begins.
        view: what it shows where there are several of an episode, as the names of the
            files say it: a further camera, or `tiled` for all sub-environments; empty
            for the first camera.
        episode: its episode; None where that is not over or was not completed.
    """

    path: Path
    metadata_path: Path
    episode_id: int
    episode: FinishedEpisode | None
    view: str = ""


class Tracker:
    """Told what a monitor records; `mjrec.Monitor(..., trackers=...)` takes them.

    To be subclassed; each method does nothing. One tracker may serve several runs at
    the same time, those of a vector environment for instance: each call says which.
    What a method raises is logged and noted in the manifest, the run is ended for that
    tracker, which is told nothing more of it, and the recording goes on.
    """

    def begin(self, run: Run) -> None:
        """Take note of a run that begins."""

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Take note of an episode that has just ended."""

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Take note of a video that is finished.

        Deferred videos finish beside the simulation and are told of when the next
        episode ends, or in `close`.
        """

    def end(self, run: Run) -> None:
        """Take note of the end of a run; nothing more of it is told."""

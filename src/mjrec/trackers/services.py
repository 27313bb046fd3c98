# SPDX-License-Identifier: Apache-2.0
"""What the services get of an episode, and under which names."""

from __future__ import annotations

import importlib

from ..errors import MissingDependency
from ..recorder.tracking import FinishedEpisode, FinishedVideo


def require(package: str, *, purpose: str) -> None:
    """Import a service's package, which is also the name of our extra.

    Raises:
        MissingDependency: it is not installed.
    """
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        # One that is installed and lacks something itself is another matter.
        if error.name != package:
            raise
        raise MissingDependency(
            package, purpose=purpose, install=f'pip install "mjrec[{package}]"'
        ) from error


def group_of(episode: FinishedEpisode | None) -> str:
    """Return what comes before the slash; of no episode, that of training."""
    return "evaluation" if episode and episode.type == "e" else "training"


def scalars_of(episode: FinishedEpisode) -> dict[str, float]:
    """Return an episode's numbers by their names."""
    scalars = {"return": float(episode.reward), "length": float(episode.length)}
    if episode.success is not None:
        scalars["success"] = float(episode.success)
    return scalars


def name_of(video: FinishedVideo) -> str:
    """Return what comes behind the slash: `video`, or `video_side` of a further one."""
    return f"video_{video.view}" if video.view else "video"

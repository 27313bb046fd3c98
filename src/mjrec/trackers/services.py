# SPDX-License-Identifier: Apache-2.0
"""The values that services log for an episode, and their names."""

from __future__ import annotations

from ..recorder.tracking import FinishedEpisode, FinishedVideo


def group_of(episode: FinishedEpisode | None) -> str:
    """Return the part of a tag before the slash: `training` or `evaluation`.

    It is `training` if there is no episode.
    """
    return "evaluation" if episode and episode.type == "e" else "training"


def scalars_of(episode: FinishedEpisode) -> dict[str, float]:
    """Return an episode's scalars, keyed by name."""
    scalars = {"return": float(episode.reward), "length": float(episode.length)}
    if episode.success is not None:
        scalars["success"] = float(episode.success)
    return scalars


def name_of(video: FinishedVideo) -> str:
    """Return the part of a tag after the slash.

    This is `video`, or `video_<view>` for an additional camera or a tiled video.
    """
    return f"video_{video.view}" if video.view else "video"

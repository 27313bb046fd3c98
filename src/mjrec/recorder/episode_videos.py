# SPDX-License-Identifier: Apache-2.0
"""The videos of a run that its trackers have not heard of yet."""

from __future__ import annotations

from pathlib import Path

from ..formats.monitor_directory import episode_of
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)


class EpisodeVideos:
    """Watches for videos, whoever makes them."""

    def __init__(self) -> None:
        self._awaited: dict[Path, None] = {}

    def expect(self, video: Path) -> None:
        """Watch for the first video of an episode or a clip."""
        self._awaited[video] = None

    def news(self) -> list[tuple[int, Path, Path]]:
        """Return what is finished since the last call.

        A video counts as soon as its metadata is there, which is written last.

        Returns:
            The number of the episode, the video and its metadata, of each.
        """
        done = [video for video in self._awaited if is_done(video)]
        for video in done:
            del self._awaited[video]
        return [
            (episode_of(name) or 0, video.with_name(name), video.with_name(about))
            for video in done
            if not is_broken(metadata_path(video))
            for name, about in finished_videos(video)
        ]

# SPDX-License-Identifier: Apache-2.0
"""A video that is counted in steps, drawn while the simulation runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..errors import Error
from .live_videos import end_each
from .subject import EpisodePictures
from .video_recorder import VideoRecorder


class LiveClip:
    """Records one such video, of one camera or a file for each; a `Clip`.

    Args:
        videos: what takes the pictures; the first camera's comes first.
        pictures: where they come from.
        on_end: called with the videos when they are closed.
        tolerates: tells whether to go on after an error.
    """

    def __init__(
        self,
        videos: Sequence[VideoRecorder],
        pictures: Sequence[EpisodePictures],
        *,
        on_end: Callable[[Sequence[VideoRecorder]], object],
        tolerates: Callable[[Exception], bool],
    ) -> None:
        self._videos = videos
        self._pictures = pictures
        self._on_end = on_end
        self._tolerates = tolerates

    def begin(self) -> None:
        """Take the picture of this moment."""
        for pictures in self._pictures:
            # Whatever a reset has made of textures and terrains.
            pictures.begin_episode()
        self._take()

    def reset(self, episode_id: int) -> None:
        """Take the picture of an episode that has just begun."""
        for video in self._videos:
            video.metadata["last_episode_id"] = episode_id
        self.begin()

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, is_there: bool
    ) -> None:
        """Take the picture of a step."""
        del reward, terminated, truncated
        if is_there:
            self._take()
            return
        for video in self._videos:
            video.metadata["final_frame"] = "missing"

    def end(self, facts: Mapping[str, Any]) -> None:
        """Finish the files. Where it was interrupted, the next call goes on."""
        for video in self._videos:
            video.metadata.update(facts)
        try:
            end_each(self._videos, self._close)
        finally:
            self._on_end(self._videos)

    def _take(self) -> None:
        for video in self._videos:
            try:
                video.capture_frame()
            except Exception as error:
                if not self._tolerates(error):
                    raise
                video.give_up(str(error))

    def _close(self, video: VideoRecorder) -> None:
        try:
            video.capture_last()
            video.close()
        except Error as error:
            if not self._tolerates(error):
                raise

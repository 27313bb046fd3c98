# SPDX-License-Identifier: Apache-2.0
"""What has become of the videos of a run, for its manifest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..formats.monitor_directory import episode_of
from ..formats.pending_videos import pending_clip, pending_video, with_reason
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)
from .deferred_clip import DeferredClip
from .deferred_video import DeferredVideo
from .video_recorder import VideoRecorder


class EpisodeVideos:
    """The videos of the episodes that are over."""

    def __init__(self) -> None:
        self._finished: list[tuple[str, str]] = []
        # What is finished and was not told of: episode, video and metadata.
        self._news: list[tuple[int, Path, Path]] = []
        self._broken: list[str] = []
        # How a manifest names them while they are pending, and where they will be.
        self._deferred: list[tuple[dict[str, Any], Path]] = []

    def add_live(self, recorder: VideoRecorder) -> None:
        """Note a video that was drawn while its episode ran."""
        assert recorder.path is not None
        assert recorder.metadata_path is not None
        names = (Path(recorder.path).name, Path(recorder.metadata_path).name)
        if recorder.broken:
            self._broken.append(names[1])
        elif recorder.finished:
            self._add_finished(Path(recorder.path), Path(recorder.metadata_path))

    def add_deferred(
        self, episode_id: int, trajectory: Path, video: DeferredVideo
    ) -> None:
        """Note a video that is to be rendered from a trajectory."""
        path = Path(video.path)
        entry = pending_video(episode_id, trajectory=trajectory.stem, video=path.name)
        self._deferred.append((entry, path))

    def add_deferred_clip(self, clip: DeferredClip) -> None:
        """Note a video that is counted in steps and is to be rendered."""
        entry = pending_clip(
            clip.episode_id, first_part=clip.first_part.name, video=clip.video.name
        )
        self._deferred.append((entry, clip.video))

    def finished(self) -> list[tuple[str, str]]:
        """Return the names of the videos that are there now, and their metadata's.

        Whoever rendered a deferred one, it counts as soon as its metadata is there,
        which is written last.
        """
        self._look_for_rendered()
        return sorted(self._finished)

    def news(self) -> list[tuple[int, Path, Path]]:
        """Return what is finished since the last call.

        Returns:
            The number of the episode, the video and its metadata, of each.
        """
        self._look_for_rendered()
        news, self._news = self._news, []
        return news

    def broken(self) -> list[str]:
        """Return the names of the metadata of videos that were given up."""
        self._look_for_rendered()
        return list(self._broken)

    def pending(
        self, reasons: Mapping[str, str] = MappingProxyType({})
    ) -> list[Mapping[str, Any]]:
        """Return what is still to be rendered.

        Args:
            reasons: why rendering has failed, by the names of videos or of logs.
        """
        self._look_for_rendered()
        return [with_reason(entry, reasons) for entry, _ in self._deferred]

    def _look_for_rendered(self) -> None:
        waiting = []
        for entry in self._deferred:
            video = entry[1]
            if not is_done(video):
                waiting.append(entry)
            elif is_broken(metadata_path(video)):
                self._broken.append(metadata_path(video).name)
            else:
                for name, about in finished_videos(video):
                    self._add_finished(video.with_name(name), video.with_name(about))
        self._deferred = waiting

    def _add_finished(self, video: Path, about: Path) -> None:
        self._finished.append((video.name, about.name))
        self._news.append((episode_of(video.name) or 0, video, about))

# SPDX-License-Identifier: Apache-2.0
"""Where the videos of a run will be, and what a trajectory says of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..formats.monitor_directory import Infix, clip_video_prefix, video_prefix
from .options import LIVE, RecorderOptions
from .subject import Subject


@dataclass(frozen=True, kw_only=True)
class VideoPromises:
    """What is known of the videos of a run before there are any.

    Attributes:
        directory: the monitor directory.
        infix: the monitor's.
        subject: what is recorded.
        options: what was asked for.
        selection: by which rule episodes are chosen after their end; empty where they
            are chosen before.
    """

    directory: Path
    infix: Infix
    subject: Subject
    options: RecorderOptions
    selection: Mapping[str, Any] = field(default_factory=dict)

    def path(self, episode_id: int) -> Path:
        """Return where an episode's video will be, without the ending."""
        return self.directory / video_prefix(self.infix, episode_id)

    def clip_path(self, episode_id: int, steps: int | None) -> Path:
        """Return where a video that is counted in steps will be, without the ending.

        Args:
            episode_id: of the episode in which it begins.
            steps: how many were taken when a step began it; None where it begins with
                the episode.
        """
        return self.directory / clip_video_prefix(self.infix, episode_id, steps)

    def of_episode(self, episode_id: int, recording: str) -> dict[str, Any]:
        """Return what a trajectory says of its episode's video.

        Args:
            episode_id: its number.
            recording: when the video is drawn, `DEFERRED` or `LIVE`.
        """
        return {
            **self.of_video(self.path(episode_id), recording),
            **self.second_name("episode", episode_id),
        }

    def of_video(self, path: Path, recording: str) -> dict[str, Any]:
        """Return what is said of any video.

        Args:
            path: where it will be, without the ending.
            recording: when it is drawn, `DEFERRED` or `LIVE`.
        """
        options, subject = self.options, self.subject
        promise: dict[str, Any] = {
            "name": f"{path.name}.mp4",
            "quality": options.quality,
            "fps": None if options.fps is None else str(options.fps),
            "max_fps": None if options.max_fps is None else str(options.max_fps),
            "recording": recording,
            "reason": subject.rendering.reason if recording == LIVE else None,
        }
        if subject.cameras:
            promise["cameras"] = list(subject.cameras)
            promise["tiled"] = options.tiled
        if options.annotate:
            promise["annotate"] = True
        if self.selection:
            promise["selection"] = self.selection
        return promise

    def second_name(self, what: str, number: int) -> dict[str, str]:
        """Return what a video is called besides, for its metadata.

        Args:
            what: it begins with, "episode" or "step".
            number: of that.
        """
        prefix = self.options.name_prefix
        if prefix is None:
            return {}
        return {"also_named": f"{prefix}-{what}-{number}.mp4"}

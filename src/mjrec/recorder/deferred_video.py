# SPDX-License-Identifier: Apache-2.0
"""The promise of a video that is rendered from a trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .trajectory_recorder import TrajectoryRecorder


class DeferredVideo:
    """Stands where a `VideoRecorder` stands when pictures are drawn live.

    Its frames are the snapshots of the episode's trajectory. The files come when
    somebody has rendered them, which the monitor's `close` waits for.

    Args:
        base_path: the video's path without extension.
        trajectory: of the episode.

    Attributes:
        path: the video, once it is rendered.
        metadata_path: its metadata, likewise.
        enabled: True.
        broken: no more frames could be taken; those before are rendered.
        closed: the episode is over.
    """

    enabled = True
    ansi_mode = False

    def __init__(self, base_path: Path, trajectory: TrajectoryRecorder) -> None:
        self.path = f"{base_path}.mp4"
        self.metadata_path = f"{base_path}.meta.json"
        self.metadata: dict[str, Any] = {}
        self.broken = False
        self.closed = False
        self._trajectory = trajectory

    @property
    def functional(self) -> bool:
        """Whether frames are (or were) recorded: not broken."""
        return not self.broken

    @property
    def empty(self) -> bool:
        """Whether there is no frame."""
        return self.frame_count == 0

    @property
    def frame_count(self) -> int:
        """The number of frames recorded so far."""
        return self._trajectory.frame_count

    @property
    def finished(self) -> bool:
        """Whether the video has been rendered and is there, whole."""
        return Path(self.path).exists() and Path(self.metadata_path).exists()

    def capture_frame(self) -> None:
        """Take the frame of this moment, unless there is one of it already."""
        if self.functional and not self.closed:
            self._trajectory.take_frame()

    def close(self) -> None:
        """Take no more frames."""
        self.closed = True

    def discard(self) -> None:
        """Leave nothing."""
        self.closed = True

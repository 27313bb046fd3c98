# SPDX-License-Identifier: Apache-2.0
"""What every monitor offers beside the environment's own interface: gym's names."""

from __future__ import annotations

from pathlib import Path

from ..recorder.recorder import Recorder
from ..recorder.stats_recorder import StatsRecorder
from ..recorder.video_recorder import VideoRecorder

__all__ = ["MonitorControls"]


class MonitorControls:
    """The part of a monitor that does not depend on the framework."""

    _recorder: Recorder

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        return self._recorder.directory

    @property
    def infix(self) -> str:
        """What the names of this monitor's files have in the middle."""
        return self._recorder.infix

    @property
    def episode_id(self) -> int:
        """The number of the next episode; it rises at each reset, as in gym."""
        return self._recorder.episode_id

    @property
    def stats_recorder(self) -> StatsRecorder:
        """Counts steps and rewards."""
        return self._recorder.stats_recorder

    @property
    def video_recorder(self) -> VideoRecorder | None:
        """Records the running episode (or not); None before the first reset."""
        return self._recorder.video_recorder

    def set_monitor_mode(self, mode: str | None) -> None:
        """Set the type of the episodes from the next reset on.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: it is something else.
        """
        self._recorder.set_mode(mode)

    def get_total_steps(self) -> int:
        """Return the number of all steps, those of unfinished episodes too."""
        return self._recorder.stats_recorder.total_steps

    def get_episode_rewards(self) -> list[float]:
        """Return the sum of rewards of each complete episode."""
        return list(self._recorder.stats_recorder.episode_rewards)

    def get_episode_lengths(self) -> list[int]:
        """Return the steps of each complete episode."""
        return list(self._recorder.stats_recorder.episode_lengths)

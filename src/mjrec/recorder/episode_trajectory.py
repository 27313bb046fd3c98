# SPDX-License-Identifier: Apache-2.0
"""The trajectory of the running episode: what goes wrong with it, and its end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten, PicturesDiffer
from .deferred_video import DeferredVideo
from .trajectory_recorder import TrajectoryRecorder

logger = logging.getLogger(__name__)


class EpisodeTrajectory:
    """Records an episode's states until it is over, or something is in the way.

    Where no picture can be made any more, the frames end and the states go on. Where
    nothing can be written any more, the trajectory ends there, and the episode goes on
    if that is tolerated.

    Args:
        recorder: writes it.
        episode_id: of the episode.
        promise: what it says of the episode's video; None where that gets none.
        stays: it is kept also where its video is not.
        tolerates: tells whether to go on after an error.

    Attributes:
        recorder: as given.
        promise: as given.
        stays: as given.
        deferred: the video that is to be rendered from it; None where there is none.
    """

    def __init__(
        self,
        recorder: TrajectoryRecorder,
        *,
        episode_id: int,
        promise: Mapping[str, Any] | None,
        stays: bool,
        tolerates: Callable[[Exception], bool],
    ) -> None:
        self.recorder = recorder
        self.promise = promise
        self.stays = stays
        self.deferred: DeferredVideo | None = None
        self._episode_id = episode_id
        self._tolerates = tolerates

    @property
    def path(self) -> Path:
        """Of the file that it becomes."""
        return self.recorder.path

    @property
    def is_there(self) -> bool:
        """Whether the log has as much of it as could be written."""
        return self.recorder.is_there

    def lacks(self, steps: int) -> bool:
        """Tell whether a step of so many is missing though nothing was in the way.

        A signal's handler may raise before a step's row is written.
        """
        return not self.recorder.is_stopped and self.recorder.steps < steps

    def before_step(self, action: Any) -> None:
        """Note the action of the coming step.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated.
        """
        try:
            self.recorder.before_step(action)
        except FileNotWritten as error:
            self._stop(error)

    def step(
        self,
        reward: float,
        terminated: bool,
        truncated: bool,
        observation: Any,
        is_last: bool,
        has_picture: bool,
    ) -> None:
        """Record a step, as `TrajectoryRecorder.step` does.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated.
        """
        try:
            self.recorder.step(
                reward, terminated, truncated, observation, is_last, has_picture
            )
        except PicturesDiffer as error:
            self._stop_frames(error)
        except FileNotWritten as error:
            self._stop(error)

    def take_frame(self) -> None:
        """Take the frame of this moment, unless there is one of it already.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated.
        """
        try:
            self.recorder.take_frame()
        except PicturesDiffer as error:
            self._stop_frames(error)
        except FileNotWritten as error:
            self._stop(error)

    def end(self, facts: Mapping[str, Any]) -> None:
        """Write what is known of the episode's end. Idempotent.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated; the next call
                tries again.
        """
        try:
            self.recorder.end(facts)
        except FileNotWritten as error:
            if not self._tolerates(error):
                raise
            self.recorder.abandon()

    def discard(self) -> None:
        """Leave nothing."""
        self.recorder.discard()

    def _stop(self, error: FileNotWritten) -> None:
        self.recorder.stop(str(error))
        self._break_video(error)
        if not self._tolerates(error):
            raise error

    def _stop_frames(self, error: PicturesDiffer) -> None:
        self.recorder.stop_frames(str(error))
        self._break_video(error)
        logger.warning(
            "The frames of episode %d end at step %d: %s",
            self._episode_id,
            self.recorder.steps,
            error,
        )

    def _break_video(self, error: Exception) -> None:
        if self.deferred is not None:
            self.deferred.broken = True
            self.deferred.metadata["broken_reason"] = str(error)

# SPDX-License-Identifier: Apache-2.0
"""Videos that last so many steps, wherever they begin and whatever ends meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..errors import Error
from .video_recorder import VideoRecorder

__all__ = ["Clips"]


class Clips:
    """The videos of a run that are counted in steps, one at a time.

    While one is recorded nothing begins another: each has the picture that it begins
    with and those of exactly `length` steps, on across resets, which add a picture
    each. Without a length it ends with the episode.

    They are drawn live: a trajectory is of one episode, and such a video need not be.

    Args:
        length: in steps; None is until the end of the episode.
        trigger: tells by the number of steps taken so far whether one begins before
            the next; None where only episodes begin them.
        begin: makes what records one; it is given the number of steps taken so far,
            or None where it begins with an episode.
        on_end: called with each, closed.
        tolerates: tells whether to go on after an error.
    """

    def __init__(
        self,
        *,
        length: int | None,
        trigger: Callable[[int], Any] | None,
        begin: Callable[[int | None], VideoRecorder],
        on_end: Callable[[VideoRecorder], object],
        tolerates: Callable[[Exception], bool],
    ) -> None:
        self._length = length
        self._trigger = trigger
        self._begin = begin
        self._on_end = on_end
        self._tolerates = tolerates
        self._video: VideoRecorder | None = None
        self._steps = 0

    def reset(self, episode_id: int, *, is_chosen: bool) -> None:
        """Take the picture of an episode that has just begun.

        Args:
            episode_id: its number.
            is_chosen: a video begins with it, unless one is running.
        """
        if self._video is not None:
            self._video.metadata["last_episode_id"] = episode_id
            self._take(self._video)
        elif is_chosen:
            self._start(None)

    def before_step(self, steps: int) -> None:
        """Begin a video, if it is its time.

        Args:
            steps: how many were taken so far.
        """
        if self._video is None and self._trigger is not None and self._trigger(steps):
            self._start(steps)

    def step(self, *, is_there: bool, done: bool) -> None:
        """Take the picture of a step.

        Args:
            is_there: False where the environment has reset itself already.
            done: the episode is over.
        """
        video = self._video
        if video is None:
            return
        self._steps += 1
        if is_there:
            self._take(video)
        else:
            video.metadata["final_frame"] = "missing"
        if self._steps == self._length or (self._length is None and done):
            self._end(video, {"complete": True})

    def close(self, facts: Mapping[str, Any]) -> None:
        """End the running video, if there is one. Idempotent.

        Args:
            facts: why it ends early.
        """
        if self._video is not None:
            self._end(self._video, {"complete": False, **facts})

    def _start(self, steps: int | None) -> None:
        self._video = video = self._begin(steps)
        self._steps = 0
        self._take(video)

    def _take(self, video: VideoRecorder) -> None:
        try:
            video.capture_frame()
        except Exception as error:
            if not self._tolerates(error):
                raise
            video.give_up(str(error))

    def _end(self, video: VideoRecorder, facts: Mapping[str, Any]) -> None:
        self._video = None
        video.metadata.update(facts, length=self._steps)
        try:
            video.capture_last()
            video.close()
        except Error as error:
            if not self._tolerates(error):
                raise
        finally:
            self._on_end(video)

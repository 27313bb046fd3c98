# SPDX-License-Identifier: Apache-2.0
"""Choosing which episodes get a video and which keep their trajectory."""

from __future__ import annotations

from ..schedules import (
    Schedule,
    capped_cubic_video_schedule,
    disable_videos,
    schedule_name,
    to_schedule,
)
from .options import OFF, RecorderOptions
from .selection import Selection, selection_from

_EVALUATION = "e"


class EpisodeChoice:
    """Decides at the beginning of an episode, by the user's options.

    Args:
        options: the user's options.
        mode: when frames are drawn.

    Attributes:
        selection: chooses among finished episodes; None if episodes are chosen when
            they begin.
    """

    def __init__(self, options: RecorderOptions, *, mode: str) -> None:
        self.selection: Selection | None = None
        self._schedule: Schedule = to_schedule(options.video_callable)
        if options.keep is not None:
            self._schedule = self.selection = selection_from(options.keep)
        if options.step_trigger is not None or mode == OFF:
            self._schedule = disable_videos
        self._trajectories = options.trajectory_callable
        stated = options.statements
        self._only_counted = stated is not None and stated.only_counted
        # The last episode number passed to each function, and its result.
        self._decided = (-1, False)
        self._kept = (-1, False)

    @property
    def schedule_name(self) -> str:
        """The schedule's name in the manifest."""
        return schedule_name(self._schedule)

    @property
    def has_videos(self) -> bool:
        """Whether any episode may get a video of its own."""
        return self._schedule is not disable_videos

    def has_chosen(self, episode_id: int) -> bool:
        """Return whether the schedule chose the running episode."""
        return self._decided == (episode_id, True)

    def will_choose(self, episode_id: int) -> bool:
        """Return whether it is already certain that an episode gets a video.

        A user's schedule is not called before the episode begins, so this is True only
        for the default schedule.
        """
        is_ours = self._schedule is capped_cubic_video_schedule
        return is_ours and self._schedule(episode_id)

    def decide(self, episode_id: int) -> bool:
        """Return whether an episode gets a video.

        The schedule is called once per episode number, although several resets may
        share it.
        """
        if self._decided[0] != episode_id:
            self._decided = (episode_id, bool(self._schedule(episode_id)))
        return self._decided[1]

    def may_keep_trajectory(self, episode_type: str) -> bool:
        """Return whether an episode of this type may keep its trajectory.

        This can be called before `decide`.
        """
        return (
            self.has_videos
            or self._trajectories is not None
            or episode_type == _EVALUATION
        )

    def keeps_trajectory(
        self, episode_id: int, *, episode_type: str, has_video: bool
    ) -> bool:
        """Return whether an episode keeps its trajectory.

        A user's function is called once per episode number, although several resets may
        share it.

        Args:
            episode_id: the episode's number.
            episode_type: "t" for training, "e" for evaluation.
            has_video: whether the episode gets a video.
        """
        asked = self._trajectories
        if self._only_counted:
            return has_video
        if asked is None:
            return has_video or episode_type == _EVALUATION
        if not callable(asked):
            return asked
        if self._kept[0] != episode_id:
            self._kept = (episode_id, bool(asked(episode_id)))
        return self._kept[1]

    def keeps_without_video(self, episode_type: str) -> bool:
        """Return whether a kept trajectory stays even if its video is dropped."""
        return self._trajectories is not None or episode_type == _EVALUATION

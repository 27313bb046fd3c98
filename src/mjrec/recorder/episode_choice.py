# SPDX-License-Identifier: Apache-2.0
"""The decision, as each episode begins, whether it gets a video or a trajectory."""

from __future__ import annotations

import functools
from typing import Any

from ..schedules import (
    Schedule,
    capped_cubic_video_schedule,
    disable_videos,
    schedule_name,
    to_schedule,
)
from .keep_rules import Selection, selection_from
from .options import RecorderOptions

_EVALUATION = "e"


class EpisodeChoice:
    """Decides what to record when an episode begins, based on the options.

    A user's function is called only once per episode number, even if several resets
    have the same number.

    Args:
        options: the user's options.
        draws: whether any videos are drawn.

    Attributes:
        selection: the object that chooses among finished episodes; None if episodes are
            chosen when they begin.
        schedule_name: the schedule's name in the manifest.
        has_videos: whether any episode may get a video of its own.
        decide: a function that returns whether an episode gets a video.
    """

    def __init__(self, options: RecorderOptions, *, draws: bool) -> None:
        self.selection: Selection | None = None
        schedule: Schedule = to_schedule(options.video_callable)
        if options.keep is not None:
            schedule = self.selection = selection_from(options.keep)
        if options.step_trigger is not None or not draws:
            schedule = disable_videos
        self.schedule_name = schedule_name(schedule)
        self.has_videos = schedule is not disable_videos
        self.decide = functools.lru_cache(maxsize=1)(schedule)
        self._is_default = schedule is capped_cubic_video_schedule
        kept = self._kept = options.trajectory_callable
        if callable(kept):
            self._kept = functools.lru_cache(maxsize=1)(kept)

    def will_choose(self, episode_id: int) -> bool:
        """Return whether an episode is already certain to get a video.

        A user's schedule is not called before the episode begins, so the result is True
        only for the default schedule.
        """
        return self._is_default and capped_cubic_video_schedule(episode_id)

    def keeps_trajectory(
        self, episode_id: int, episode_type: str, has_video: bool
    ) -> Any:
        """Return whether an episode keeps its trajectory.

        Args:
            episode_id: the episode's number.
            episode_type: "t" for training, "e" for evaluation.
            has_video: whether the episode gets a video.
        """
        kept = self._kept
        if kept is None:
            return has_video or episode_type == _EVALUATION
        return kept(episode_id) if callable(kept) else kept

    def keeps_without_video(self, episode_type: str) -> bool:
        """Return whether a trajectory is kept even if its video is dropped."""
        return self._kept is not None or episode_type == _EVALUATION

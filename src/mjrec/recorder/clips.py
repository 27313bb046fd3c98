# SPDX-License-Identifier: Apache-2.0
"""Clips: videos of N steps, which may cross episodes.

A clip may continue across resets, but a recording belongs to one episode. Therefore, a
clip has one recording, called a part, for each episode that it overlaps. The field
`clip` in a part's facts has these keys:

- `first_step`: number of steps that the monitor had recorded when the clip began
- `part`: the part's number, counted from 0
- `steps_before`: number of steps in the running episode before the part begins
- `reward_before`: sum of the rewards of these steps
- `reset_time`: simulated time of the episode's reset, if frames show the time

The final facts of the last part contain `complete`, like those of an episode's
trajectory. The final facts of earlier parts contain `continues`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..formats.monitor_directory import clip_part_name, clip_video_prefix
from .live_videos import LiveVideos, live_videos
from .monitored_run import MonitoredRun
from .options import DEFERRED, LIVE
from .states import StateRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart


class Clips:
    """The clips of a run, recorded one at a time.

    No clip begins while another clip is being recorded. A clip consists of a first
    frame and the frames of exactly `video_length` steps. It continues across resets,
    and each reset adds a frame. If no length is set, the clip ends with the episode.

    Args:
        run: the monitored run. Two of its options define the clips. `video_length` is
            the length in steps, or None for the rest of the episode. `step_trigger` is
            called with the number of steps taken so far and returns whether a clip
            begins before the next step. If it is None, clips begin only with episodes.
    """

    def __init__(self, run: MonitoredRun) -> None:
        self._run = run
        self._length = run.options.video_length
        self._trigger = run.options.step_trigger
        self._clip: _Clip | None = None

    def reset(self, *, is_chosen: bool) -> None:
        """Take the first frame of an episode that has just begun.

        Args:
            is_chosen: whether to begin a clip with the episode. This is ignored while a
                clip is running.
        """
        if self._clip is not None:
            self._clip.reset()
        elif is_chosen:
            self._start(None)

    def before_step(self) -> None:
        """Begin a clip if `step_trigger` chooses this step."""
        if self._clip is None and self._trigger is not None:
            taken = self._run.stats.total_steps
            if self._run.ask("video", self._trigger, taken):
                self._start(taken)

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, has_frame: bool
    ) -> None:
        """Record a step; see `StateRecorder.step`."""
        clip = self._clip
        if clip is None:
            return
        clip.steps += 1
        clip.reward += reward
        is_over = self._length is None and (terminated or truncated)
        try:
            clip.step(reward, terminated, truncated, has_frame=has_frame)
        finally:
            if clip.steps == self._length or is_over:
                self._end({"complete": True})

    def close(self, facts: Mapping[str, Any]) -> None:
        """End the running clip, if there is one. Idempotent.

        Args:
            facts: the facts about why the clip ends early.
        """
        self._end({"complete": False, **facts})

    def leave(self) -> None:
        """Release the files as they are, so that recovery can finish them."""
        if self._clip is not None and self._clip.live is not None:
            self._clip.live.leave()

    def _start(self, steps: int | None) -> None:
        self._clip = _Clip(self._run, steps)
        if self._clip.live is not None:
            self._clip.live.begin()

    def _end(self, facts: Mapping[str, Any]) -> None:
        clip, self._clip = self._clip, None
        if clip is not None:
            clip.end(facts)


class _Clip:
    """A clip that is either drawn live or recorded in parts, one per episode.

    Args:
        run: the monitored run.
        taken: number of steps so far if a step triggered the clip; None if it began
            with an episode.

    Attributes:
        steps: number of steps in the clip.
        reward: sum of the rewards of these steps.
        live: the live videos; None if the clip is rendered later.
    """

    def __init__(self, run: MonitoredRun, taken: int | None) -> None:
        self.steps, self.reward = 0, 0.0
        self.live: LiveVideos | None = None
        self._run = run
        self._first_step = run.stats.total_steps
        self._episode_id = self._last_episode_id = run.episode.episode_id
        path = run.directory / clip_video_prefix(run.infix, self._episode_id, taken)
        self._part: StateRecorder | None = None
        self._parts = 0
        start = None
        if run.env.rendering.mode == DEFERRED:
            assert run.of_clips.capture is not None
            start = run.of_clips.capture.begin_episode()
            start = start if run.can_be_deferred(start) else None
        if start is not None:
            self._pending_video = run.pending_video(path.name, DEFERRED)
            self._video = path.with_name(f"{path.name}.mp4")
            self._begin_part(start)
        else:
            self.live = live_videos(run, path)
            self._video = self.live.path
            self.live.say(first_step=self._first_step, last_episode_id=self._episode_id)

    def reset(self) -> None:
        """Take the first frame of an episode and begin a new part."""
        self._last_episode_id = self._run.episode.episode_id
        if self.live is not None:
            self.live.say(last_episode_id=self._last_episode_id)
            self.live.begin()
        part, capture = self._part, self._run.of_clips.capture
        if part is None or part.broken_reason is not None:
            return
        assert capture is not None
        start = capture.begin_episode()
        if start.refusal is not None:
            part.end_frames(start.refusal)
            return
        part.end({"continues": True, "end_time": self._run.clock()})
        if part.broken_reason is None:
            self._begin_part(start)

    def step(
        self, reward: float, terminated: bool, truncated: bool, *, has_frame: bool
    ) -> None:
        """Record a step."""
        if self.live is not None:
            self.live.take(is_there=has_frame, last=False)
        part = self._part
        if part is None or part.broken_reason is not None:
            return
        if not has_frame:
            part.note(final_frame="missing")
        part.step(
            reward, terminated=terminated, truncated=truncated, has_frame=has_frame
        )

    def end(self, facts: Mapping[str, Any]) -> None:
        """End the clip and submit it."""
        run = self._run
        known = {**facts, "length": self.steps, "reward": self.reward}
        try:
            if self.live is not None:
                try:
                    self.live.take_last()
                finally:
                    self.live.end(known)
            elif self._part is not None:
                last = {"last_episode_id": self._last_episode_id}
                self._part.end({**known, **last, "end_time": run.clock()})
        finally:
            said = {"episode_id": self._episode_id, "video": self._video.name}
            if self.live is not None:
                run.note("clip", {**said, "recording": LIVE})
                run.trackers.expect(self._video)
                self.live.give_second_names()
            # Otherwise, the disk was too full for even a single row, and there will be
            # no video.
            elif self._parts > 1 or (self._part is not None and self._part.is_there):
                run.note("clip", {**said, "clip": self._name(0)})
                run.trackers.expect(self._video)
                run.submit(run.directory / self._name(0))

    def _begin_part(self, start: EpisodeStart) -> None:
        """Begin a new part."""
        run = self._run
        clip = {
            "first_step": self._first_step,
            "part": self._parts,
            "steps_before": run.stats.steps or 0,
            "reward_before": run.stats.rewards or 0.0,
            "reset_time": run.episode.reset_clock,
        }
        facts = {"kept": False, "video": self._pending_video, "clip": clip}
        self._part = StateRecorder(
            run, self._name(self._parts), facts=facts, start=start, is_clip=True
        )
        self._parts += 1

    def _name(self, number: int) -> str:
        return clip_part_name(self._run.infix, self._first_step, number)

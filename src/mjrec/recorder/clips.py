# SPDX-License-Identifier: Apache-2.0
"""Clips: videos of N steps, which may cross episodes.

A clip may go on across resets, and a recording is of one episode: so there is one for
each part of it that is of one episode. `clip` in the facts of a part says

- `first_step`: how many steps the monitor had recorded when the video began;
- `part`: its number, from 0;
- `steps_before`: of the running episode, before the part begins;
- `reward_before`: their rewards;
- `reset_time`: the simulated time of that episode's reset, where it is to be written on
  the frames.

The last part ends as an episode's trajectory does, with `complete`; those before say
`continues`.
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
    """The videos of a run that are counted in steps, one at a time.

    While one is recorded nothing begins another: each has the frame that it begins
    with and those of exactly `length` steps, on across resets, which add a frame
    each. Without a length it ends with the episode.

    Args:
        run: the monitored run. `video_length` is theirs in steps, None until the end of
            the episode; `step_trigger` tells by the number of steps taken so far
            whether one begins before the next, None where only episodes begin them.
    """

    def __init__(self, run: MonitoredRun) -> None:
        self._run = run
        self._length = run.options.video_length
        self._trigger = run.options.step_trigger
        self._clip: _Clip | None = None

    def reset(self, *, is_chosen: bool) -> None:
        """Take the frame of an episode that has just begun.

        Args:
            is_chosen: a video begins with it, unless one is running.
        """
        if self._clip is not None:
            self._clip.reset()
        elif is_chosen:
            self._start(None)

    def before_step(self) -> None:
        """Begin a video, if it is its time."""
        taken = self._run.stats.total_steps
        if self._clip is None and self._trigger is not None:
            is_chosen: Any = False
            with self._run.tolerating("video", Exception):
                is_chosen = self._trigger(taken)
            if is_chosen:
                self._start(taken)

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, has_frame: bool
    ) -> None:
        """Take the frame of a step; as `StateRecorder.step`."""
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
        """End the running video, if there is one. Idempotent.

        Args:
            facts: why it ends early.
        """
        self._end({"complete": False, **facts})

    def leave(self) -> None:
        """Let go of the files as they are; recovery finishes them."""
        if self._clip is not None and self._clip.live is not None:
            self._clip.live.leave()

    def _start(self, steps: int | None) -> None:
        self._clip = _Clip(self._run, steps)
        self._clip.begin()

    def _end(self, facts: Mapping[str, Any]) -> None:
        clip, self._clip = self._clip, None
        if clip is not None:
            clip.end(facts)


class _Clip:
    """One video, drawn live, or recorded in parts of one episode each.

    Args:
        run: the monitored run.
        taken: the steps so far, where a step began it; None where it begins with an
            episode.

    Attributes:
        steps: how many it has.
        reward: their sum.
        live: draws it, or not.
    """

    def __init__(self, run: MonitoredRun, taken: int | None) -> None:
        self.steps, self.reward = 0, 0.0
        self.live: LiveVideos | None = None
        self._run = run
        self._first_step = run.stats.total_steps
        self._episode_id = self._last_episode_id = run.episode.episode_id
        path = run.directory / clip_video_prefix(run.infix, self._episode_id, taken)
        second_name = run.second_name("episode", self._episode_id)
        if taken is not None:
            second_name = run.second_name("step", taken)
        self._part: StateRecorder | None = None
        self._parts = 0
        start = None
        if run.env.rendering.mode == DEFERRED:
            assert run.env.clip_states is not None
            start = run.env.clip_states.begin_episode()
            start = start if run.can_be_deferred(start) else None
        if start is not None:
            self._pending_video = run.pending_video(
                path.name, DEFERRED, second_name=second_name
            )
            self._video = path.with_name(f"{path.name}.mp4")
            self._begin_part(start)
        else:
            self.live = live_videos(run, path, second_name=second_name)
            self._video = self.live.path
            self.live.say(first_step=self._first_step, last_episode_id=self._episode_id)

    def begin(self) -> None:
        """Take the frame of this moment, where it is drawn live."""
        if self.live is not None:
            self.live.begin()

    def reset(self) -> None:
        """Take the frame of an episode that has just begun."""
        self._last_episode_id = self._run.episode.episode_id
        if self.live is not None:
            self.live.say(last_episode_id=self._last_episode_id)
            self.live.begin()
        part, capture = self._part, self._run.env.clip_states
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
        """Take the frame of a step."""
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
        """Write what is known of the end, and hand the video on."""
        run = self._run
        known = {**facts, "length": self.steps, "reward": self.reward}
        said = {"episode_id": self._episode_id, "video": self._video.name}
        if self.live is not None:
            try:
                try:
                    self.live.take_last()
                finally:
                    self.live.end(known)
            finally:
                run.note("clip", {**said, "recording": LIVE})
                run.trackers.expect(self._video)
                self.live.name_again()
        elif self._part is not None:
            try:
                last = {"last_episode_id": self._last_episode_id}
                self._part.end({**known, **last, "end_time": run.clock()})
            finally:
                # Else the disk was too full for a single row: no video will come.
                if self._parts > 1 or self._part.is_there:
                    run.note("clip", {**said, "clip": self._name(0)})
                    run.trackers.expect(self._video)
                    self._part.submit(run.directory / self._name(0))

    def _begin_part(self, start: EpisodeStart) -> None:
        """Record the part that begins now."""
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
            run,
            self._name(self._parts),
            logs=run.clip_logs,
            what="video",
            facts={**run.recording_facts(start), **facts},
            capture=run.env.clip_states,
            start=start,
            # What was done is of no use to a frame. Which frames are wanted is chosen
            # when they are drawn, because they are counted over all parts: so `max_fps`
            # is not said here.
            has_actions=False,
        )
        self._parts += 1

    def _name(self, number: int) -> str:
        return clip_part_name(self._run.infix, self._first_step, number)

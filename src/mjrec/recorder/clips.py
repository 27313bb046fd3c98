# SPDX-License-Identifier: Apache-2.0
"""Videos that last so many steps, wherever they begin and whatever ends meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from .deferred_clip import DeferredClip
from .live_videos import LiveClip
from .monitored_run import MonitoredRun
from .options import DEFERRED


class Clip(Protocol):
    """What records one video that is counted in steps, and lists it at its end."""

    def begin(self) -> None:
        """Take the picture of this moment."""

    def reset(self, episode_id: int) -> None:
        """Take the picture of an episode that has just begun.

        Args:
            episode_id: its number.
        """

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, is_there: bool
    ) -> None:
        """Take the picture of a step.

        Args:
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            is_there: False where the environment has reset itself already.
        """

    def end(self, facts: Mapping[str, Any]) -> None:
        """End the video. Where it was interrupted, the next call goes on.

        Args:
            facts: what is known of its end.
        """


class Clips:
    """The videos of a run that are counted in steps, one at a time.

    While one is recorded nothing begins another: each has the picture that it begins
    with and those of exactly `length` steps, on across resets, which add a picture
    each. Without a length it ends with the episode.

    Args:
        run: of which they are. `video_length` is theirs in steps, None until the end of
            the episode; `step_trigger` tells by the number of steps taken so far
            whether one begins before the next, None where only episodes begin them.
    """

    def __init__(self, run: MonitoredRun) -> None:
        self._run = run
        self._length = run.options.video_length
        self._trigger = run.options.step_trigger
        self._clip: Clip | None = None
        self._steps = 0
        self._reward = 0.0
        # How the running one has ended, until that is all written down.
        self._ending: Mapping[str, Any] | None = None

    def reset(self, episode_id: int, *, is_chosen: bool) -> None:
        """Take the picture of an episode that has just begun.

        Args:
            episode_id: its number.
            is_chosen: a video begins with it, unless one is running.
        """
        self._settle()
        if self._clip is not None:
            self._clip.reset(episode_id)
        elif is_chosen:
            self._start(None)

    def before_step(self, steps: int) -> None:
        """Begin a video, if it is its time.

        Args:
            steps: how many were taken so far.
        """
        if self._ending is not None:
            self._settle()
        if self._clip is None and self._trigger is not None and self._trigger(steps):
            self._start(steps)

    def step(
        self,
        reward: float,
        *,
        terminated: bool,
        truncated: bool,
        is_there: bool,
    ) -> None:
        """Take the picture of a step.

        Args:
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            is_there: False where the environment has reset itself already.
        """
        clip = self._clip
        if clip is None:
            return
        self._steps += 1
        self._reward += reward
        done = terminated or truncated
        if self._steps == self._length or (self._length is None and done):
            self._ending = {"complete": True}
        try:
            clip.step(
                reward, terminated=terminated, truncated=truncated, is_there=is_there
            )
        finally:
            self._settle()

    def close(self, facts: Mapping[str, Any]) -> None:
        """End the running video, if there is one. Idempotent.

        Args:
            facts: why it ends early.
        """
        if self._clip is not None and self._ending is None:
            self._ending = {"complete": False, **facts}
        self._settle()

    def _start(self, steps: int | None) -> None:
        clip = _new_clip(self._run, steps)
        self._clip = clip
        self._steps, self._reward = 0, 0.0
        clip.begin()

    def _settle(self) -> None:
        """End the running video, if it is over."""
        if self._clip is None or self._ending is None:
            return
        try:
            self._clip.end(
                {**self._ending, "length": self._steps, "reward": self._reward}
            )
        except Exception:
            # There is nothing more to be had of it. After Ctrl-C there is.
            self._clip = self._ending = None
            raise
        self._clip = self._ending = None


def _new_clip(run: MonitoredRun, steps: int | None) -> Clip:
    """Return what records a clip that begins now.

    Args:
        run: of which it is.
        steps: how many were taken when a step began it; None where it begins with an
            episode.
    """
    path = run.clip_path(steps)
    second_name = run.second_name("episode", run.episode.episode_id)
    if steps is not None:
        second_name = run.second_name("step", steps)
    states = run.subject.clip_states
    if states is not None and run.subject.rendering.mode == DEFERRED:
        start = states.begin_episode()
        if run.can_be_deferred(start):
            return DeferredClip(run, states, start, path, second_name=second_name)
    return LiveClip(run, run.live_recorders(path, second_name=second_name))

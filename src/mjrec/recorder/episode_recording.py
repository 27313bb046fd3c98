# SPDX-License-Identifier: Apache-2.0
"""What is recorded of one episode: its states, its videos, or nothing."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .deferred_video import DeferredVideo
from .episode_trajectory import EpisodeTrajectory
from .fast_path import FastPath, counting
from .keep_rules import Standing
from .kept_videos import KeptVideos
from .live_videos import LiveVideos
from .monitored_run import MonitoredRun
from .options import DEFERRED, LIVE
from .trajectory_recorder import TrajectoryRecorder
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart


class EpisodeRecording:
    """Records one episode, from its reset to its end.

    Args:
        run: of which it is.
        kept: settles later which videos are kept; None where all are.
        on_picture_error: called with an error that is raised while a frame of a step
            is drawn live: it may be the environment's own.

    Attributes:
        video: records it (or not), live or for later.
    """

    def __init__(
        self,
        run: MonitoredRun,
        kept: KeptVideos | None,
        *,
        on_picture_error: Callable[[Exception], object],
    ) -> None:
        self.video: VideoRecorder | DeferredVideo | None = None
        self._run = run
        self._kept = kept
        self._on_picture_error = on_picture_error
        self._trajectory: EpisodeTrajectory | None = None
        self._live: LiveVideos | None = None

    @property
    def mode(self) -> str | None:
        """`DEFERRED` or `LIVE`; None where the episode gets no video of its own."""
        if self._live is not None:
            return LIVE
        return DEFERRED if isinstance(self.video, DeferredVideo) else None

    def begin(
        self, observation: Any, *, wants_video: bool, keeps: bool, stays: bool
    ) -> None:
        """Record the reset.

        Args:
            observation: what it returned.
            wants_video: the episode gets a video.
            keeps: its trajectory is kept.
            stays: it is kept also where its video is not.
        """
        run, states = self._run, self._run.subject.states
        deferred = wants_video and run.subject.rendering.mode == DEFERRED
        start = None
        if states is not None and (keeps or deferred):
            start = states.begin_episode()
            deferred = deferred and run.can_be_deferred(start)
        if keeps or deferred:
            mode = DEFERRED if deferred else LIVE
            self._trajectory = self._new_trajectory(
                start,
                observation,
                promise=self._promise(mode) if wants_video else None,
                is_kept=keeps,
                stays=stays,
            )
        if deferred:
            assert self._trajectory is not None
            run.finisher.expect()
            self.video = self._trajectory.deferred = DeferredVideo(
                run.video_path(run.episode.episode_id), self._trajectory.recorder
            )
        else:
            self._begin_live(enabled=wants_video)

    def give_up(self, reason: str) -> None:
        """Draw no frames, after an error at the reset; states are recorded."""
        if self._live is not None:
            self._live.give_up(reason)
        else:
            self._begin_live(enabled=False)

    def fast_path(self) -> FastPath | None:
        """Return what the coming steps may be recorded with, if they are usual."""
        if self._live is not None:
            return None
        if self._trajectory is None:
            return counting(self._run.stats)
        return self._trajectory.recorder.fast_path(self._run.stats)

    def before_step(self, action: Any) -> None:
        """Note the action of the coming step."""
        if self._trajectory is not None:
            self._trajectory.before_step(action)

    def step(
        self,
        reward: float,
        *,
        terminated: bool,
        truncated: bool,
        observation: Any,
        picture: bool,
    ) -> None:
        """Record a step; as `Recorder.step`."""
        done = bool(terminated or truncated)
        if self._trajectory is not None:
            self._trajectory.step(
                reward, terminated, truncated, observation, done, picture
            )
        if self._live is not None:
            self._live.take(is_there=picture, last=done)

    def lacks(self, steps: int) -> bool:
        """Tell whether a step of so many is missing though nothing was in the way."""
        return self._trajectory is not None and self._trajectory.lacks(steps)

    def take_last(self) -> None:
        """Take the frame of the last step, if it was left out."""
        if self._trajectory is not None:
            self._trajectory.take_frame()
        if self._live is not None:
            self._live.take_last()

    def discard(self) -> None:
        """Leave nothing."""
        for each in (self.video, self._live, self._trajectory):
            if each is not None:
                each.discard()
        self._trajectory = None

    def end(self, facts: Mapping[str, Any], standing: Standing) -> None:
        """Finish the trajectory and the videos. Idempotent.

        Args:
            facts: of the episode's end.
            standing: whether the video is kept.
        """
        try:
            self._end_trajectory(facts, standing)
        finally:
            if self._live is not None:
                self._end_live(self._live, facts, standing)

    def _promise(self, mode: str) -> dict[str, Any]:
        run, number = self._run, self._run.episode.episode_id
        second_name = run.second_name("episode", number)
        return run.promise(run.video_path(number), mode, second_name=second_name)

    def _new_trajectory(
        self,
        start: EpisodeStart | None,
        observation: Any,
        *,
        promise: Mapping[str, Any] | None,
        is_kept: bool,
        stays: bool,
    ) -> EpisodeTrajectory:
        run = self._run
        facts = {
            **run.recording_facts(start),
            "random_state": run.episode.random_state,
            "kept": is_kept,
            "video": promise,
        }
        if self._kept is not None:
            facts["candidate"] = promise is not None
        recorder = TrajectoryRecorder(
            run.logs,
            run.trajectory_name(),
            facts=facts,
            states=None if start is None else run.subject.states,
            start=start,
            pace=run.pace,
            observation=observation if run.options.observations else None,
            # It may be dropped without the others.
            is_alone=self._kept is not None and promise is not None,
        )
        return EpisodeTrajectory(
            recorder,
            episode_id=run.episode.episode_id,
            promise=promise,
            stays=is_kept and stays,
            tolerates=functools.partial(run.tolerates, "trajectory"),
        )

    def _begin_live(self, *, enabled: bool) -> None:
        run, number = self._run, self._run.episode.episode_id
        recorders = run.live_recorders(
            run.video_path(number),
            second_name=run.second_name("episode", number),
            enabled=enabled,
        )
        self.video = recorders[0]
        if self.video.enabled:
            self._live = LiveVideos(
                recorders,
                tolerates=functools.partial(run.tolerates, "video"),
                on_picture_error=self._on_picture_error,
            )
            self._live.begin()

    def _end_trajectory(self, facts: Mapping[str, Any], standing: Standing) -> None:
        trajectory, kept = self._trajectory, self._kept
        if trajectory is None:
            return
        if standing is Standing.DROPPED and not trajectory.stays:
            trajectory.discard()
            self._trajectory = None
            return
        verdict: Mapping[str, Any] = {}
        if kept is not None and trajectory.promise is not None:
            verdict = kept.verdict(standing, trajectory.promise)
        trajectory.end(
            {
                **facts,
                **verdict,
                "length": trajectory.recorder.steps,
                "reward": self._run.stats.rewards,
                "end_time": time.time(),
            }
        )
        self._trajectory = None
        if trajectory.is_there:
            self._hand_on(trajectory, standing)
        # Else the disk was too full for a single row: there is nothing to promise.

    def _hand_on(self, trajectory: EpisodeTrajectory, standing: Standing) -> None:
        """Let others keep, render or finish a trajectory that is whole."""
        deferred = trajectory.deferred
        if deferred is not None:
            deferred.close()
        if self._kept is not None and standing is Standing.CANDIDATE:
            self._kept.hold_trajectory(
                self._run.episode.episode_id,
                trajectory.path,
                size=trajectory.recorder.size,
                promise=trajectory.promise or {},
                stays=trajectory.stays,
                deferred=deferred,
            )
            return
        if deferred is not None and standing is Standing.CHOSEN:
            self._run.videos.expect(Path(deferred.path))
        self._run.finisher.submit(trajectory.path)

    def _end_live(
        self, videos: LiveVideos, facts: Mapping[str, Any], standing: Standing
    ) -> None:
        """Finish the videos that were drawn live; what is known goes with them."""
        if standing is Standing.DROPPED:
            videos.discard()
            return
        run, kept = self._run, self._kept
        known = {**facts, "length": run.stats.steps, "reward": run.stats.rewards}
        if kept is not None and standing is Standing.CHOSEN:
            known["selection"] = kept.chosen_facts()

        def list_one(recorder: VideoRecorder) -> None:
            if kept is not None and standing is Standing.CANDIDATE:
                kept.hold_live(run.episode.episode_id, recorder)
            elif recorder.path is not None and "first_video" not in recorder.metadata:
                run.videos.expect(Path(recorder.path))

        try:
            videos.end(known, list_one)
        finally:
            if standing is Standing.CHOSEN:
                videos.name_again()

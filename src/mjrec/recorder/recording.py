# SPDX-License-Identifier: Apache-2.0
"""The recording of one episode, with or without states and videos."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileNotWritten
from ..formats.monitor_directory import trajectory_prefix, video_prefix
from .fast_path import FastPath, counting
from .live_videos import LiveVideos, live_videos
from .monitored_run import MonitoredRun
from .options import DEFERRED, LIVE
from .states import DeferredVideo, StateRecorder
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart


class EpisodeRecording:
    """Records one episode from its reset to its end, and then keeps or drops it.

    Args:
        run: the monitored run.
        episode_id: the episode's number.
        start_time: time just before the reset, in seconds since the Unix epoch.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        random_state: state of the environment's random generator before the reset, as
            JSON values; None if unknown or not needed.

    Attributes:
        type: `"t"` for training, `"e"` for evaluation.
        reset_clock: simulated time of the reset, if frames show the time.
        is_chosen: whether the schedule chose the episode.
        video: the live or deferred video recorder. It is disabled if the episode gets
            no video.
        states: the recorder of the states; None if states are not recorded.
        live: the live videos; None if no videos are drawn live.
        stays: whether the states are kept even if the video is dropped.
        is_over: whether the episode has ended.
    """

    def __init__(
        self,
        run: MonitoredRun,
        *,
        episode_id: int,
        start_time: float,
        seed: Any,
        options: Any,
        random_state: Any,
    ) -> None:
        self.episode_id, self.start_time = episode_id, start_time
        self.seed, self.options = seed, options
        self.type = run.stats.episode_type
        self.reset_clock = run.env.clock() if run.options.annotate else None
        self.video: VideoRecorder | DeferredVideo = run.no_video
        self.states: StateRecorder | None = None
        self.live: LiveVideos | None = None
        self.is_chosen = self.stays = self.is_over = False
        self._run = run
        self._random_state = random_state
        self._name = trajectory_prefix(run.infix, episode_id)
        # The facts about the video for the log; None if the episode gets no video.
        self._pending_video: Mapping[str, Any] | None = None

    @property
    def mode(self) -> str | None:
        """`DEFERRED` or `LIVE`, or None if the episode gets no video of its own."""
        if self.live is not None:
            return LIVE
        return DEFERRED if isinstance(self.video, DeferredVideo) else None

    def begin(
        self, observation: Any, *, wants_video: bool, keeps: bool, stays: bool
    ) -> None:
        """Record the reset.

        Args:
            observation: the reset's observation.
            wants_video: whether the episode gets a video.
            keeps: whether its trajectory is kept.
            stays: whether the trajectory is kept even if the video is dropped.
        """
        run, capture = self._run, self._run.env.states
        if keeps or wants_video:
            self._path = run.logs.path_of(self._name)
        deferred = wants_video and run.env.rendering.mode == DEFERRED
        if deferred:
            # The finisher starts while the model is inspected.
            run.finisher.expect(self._path)
        start = None
        if capture is not None and (keeps or deferred):
            start = capture.begin_episode()
            deferred = deferred and run.can_be_deferred(start)
        name = video_prefix(run.infix, self.episode_id)
        second_name = run.second_name("episode", self.episode_id)
        if keeps or deferred:
            if wants_video:
                mode = DEFERRED if deferred else LIVE
                self._pending_video = run.pending_video(
                    name, mode, second_name=second_name
                )
            self.stays = keeps and stays
            self.states = self._new_states(start, observation, name, is_kept=keeps)
        if deferred:
            assert self.states is not None
            self.video = DeferredVideo(run.directory, name, self.states)
        elif wants_video:
            live = live_videos(run, run.directory / name, second_name=second_name)
            self.video = live.recorders[0]
            if self.video.enabled:
                self.live = live
                live.begin()

    def fast_path(self) -> FastPath | None:
        """Return the fast path for the next steps, or None if it cannot be used."""
        if self.live is not None:
            return None
        if self.states is None:
            return counting(self._run.stats)
        return self.states.fast_path()

    def take_last(self) -> None:
        """Take the frame of the last step if it was left out."""
        if self.states is not None:
            self.states.take_frame()
        if self.live is not None:
            self.live.take_last()

    def discard(self) -> None:
        """Discard everything that was recorded of the episode."""
        if self.live is not None:
            self.live.discard()
            self.live = None
        if self.states is not None:
            # If the disk is full, a later write reports it.
            with contextlib.suppress(FileNotWritten):
                self.states.drop()
            self.states = None

    def leave(self) -> None:
        """Release the live videos as they are, so that recovery can finish them."""
        if self.live is not None:
            self.live.leave()

    def end(self, facts: Mapping[str, Any], *, end_time: float) -> None:
        """Write the final facts, and finish live videos.

        Args:
            facts: the facts about the episode's end.
            end_time: the time of the end, in seconds since the epoch.
        """
        stats = self._run.stats
        known = {**facts, "length": stats.steps, "reward": stats.rewards}
        try:
            if self.states is not None:
                own = {"length": self.states.steps, "end_time": end_time}
                self.states.end({**known, **own})
        finally:
            if self.live is not None:
                self.live.end(known)

    def hand_on(self) -> None:
        """Submit the recording to the finisher, and announce videos to the trackers."""
        self.expect()
        self._submit()

    def expect(self) -> None:
        """Arrange for trackers to be notified of the videos once they exist."""
        if self.mode is not None and self._run.trackers:
            self._run.trackers.expect(Path(str(self.video.path)))
        if self.live is not None:
            self.live.name_again()

    def choose(self, selection: Mapping[str, Any]) -> None:
        """Keep the video of an episode that was chosen after its end.

        Args:
            selection: the facts about the choice.

        Raises:
            FileNotWritten: the disk is too full to record the choice. The recording is
                submitted anyway.
        """
        try:
            if self.live is not None:
                self.live.amend({"selection": dict(selection)})
            if self.states is not None and self._pending_video is not None:
                video = {**self._pending_video, "selection": selection}
                self.states.amend({"candidate": False, "video": video})
        finally:
            self.hand_on()

    def drop(self) -> None:
        """Drop the video of an ended episode, and its states unless `stays` is set.

        Raises:
            DirectoryNotWritable: the files cannot be removed.
            FileNotWritten: the states are kept, but the disk is too full to record that
                the video was dropped.
        """
        if self.live is not None:
            self.live.remove()
            self.live = None
        if self.states is None or not self.states.is_there:
            return
        if self.stays:
            self.states.amend({"candidate": False, "video": None})
            self._submit()
            self._run.note("dropped", self.episode_id)
        else:
            self.states.drop()

    def _submit(self) -> None:
        # Without a span the disk was too full for a single row: no video will come.
        if self.states is not None and self.states.is_there:
            self._run.submit(self._path)

    def _new_states(
        self, start: EpisodeStart | None, observation: Any, name: str, *, is_kept: bool
    ) -> StateRecorder:
        run = self._run
        facts = {
            **run.recording_facts(start),
            "random_state": self._random_state,
            "kept": is_kept,
            "video": self._pending_video,
        }
        if self._pending_video is None and run.env.rendering.mode == DEFERRED:
            # Needed if episodes of several monitors are chosen later.
            facts["possible_video"] = run.pending_video(name, DEFERRED, second_name={})
        is_candidate = bool(run.selection) and self._pending_video is not None
        if run.selection:
            facts["candidate"] = is_candidate
        return StateRecorder(
            run,
            self._name,
            logs=run.logs,
            what="trajectory",
            facts=facts,
            capture=None if start is None else run.env.states,
            start=start,
            max_fps=run.options.max_fps,
            observation=observation if run.options.observations else None,
            # A candidate needs its own log, because it may be dropped while other
            # episodes are kept.
            is_alone=is_candidate,
        )

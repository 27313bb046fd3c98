# SPDX-License-Identifier: Apache-2.0
"""The recording of one episode, with or without states and videos.

If videos are chosen after their episodes have ended, every episode is recorded as if it
were to get a video. Recordings are held until a decision is made, and the log marks
each of them as a candidate. While the monitor is open, other processes leave candidates
alone. After that, any process may render them. Dropped recordings are deleted
immediately.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileNotWritten, InvalidArgument
from ..formats.monitor_directory import trajectory_prefix, video_prefix
from .endings import Failures
from .fast_path import FastPath, counting
from .keep_rules import Selection, Standing
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
        run: the monitored run, in which the episode is running.

    Attributes:
        episode: the facts about the episode.
        is_chosen: whether the schedule chose the episode.
        video: the live or deferred video recorder. It is disabled if the episode gets
            no video.
        states: the recorder of the states; None if states are not recorded.
        live: the live videos; None if no videos are drawn live.
        stays: whether the states are kept even if the video is dropped.
        is_over: whether the episode has ended.
    """

    def __init__(self, run: MonitoredRun) -> None:
        self.episode = run.episode
        self.video: VideoRecorder | DeferredVideo = run.no_video
        self.states: StateRecorder | None = None
        self.live: LiveVideos | None = None
        self.is_chosen = self.stays = self.is_over = False
        self._run = run
        self._name = trajectory_prefix(run.infix, self.episode.episode_id)
        # The facts about the video for the log; None if the episode gets no video.
        self._pending_video: Mapping[str, Any] | None = None

    @property
    def mode(self) -> str | None:
        """`DEFERRED` or `LIVE`, or None if the episode gets no video of its own."""
        if self.live is not None:
            return LIVE
        return DEFERRED if isinstance(self.video, DeferredVideo) else None

    def begin(self, observation: Any, *, wants_video: bool) -> None:
        """Record the reset.

        Args:
            observation: the reset's observation.
            wants_video: whether the episode gets a video.
        """
        run, capture = self._run, self._run.of_episodes.capture
        number, kind, *_ = self.episode
        choose = run.choice.keeps_trajectory
        keeps = run.ask("trajectory", choose, number, kind, wants_video)
        if keeps or wants_video:
            self._path = run.of_episodes.logs.path_of(self._name)
        deferred = wants_video and run.env.rendering.mode == DEFERRED
        if deferred:
            # The finisher starts while the model is inspected.
            run.finisher.expect(self._path)
        start = None
        if capture is not None and (keeps or deferred):
            start = capture.begin_episode()
            deferred = deferred and run.can_be_deferred(start)
        name = video_prefix(run.infix, number)
        if keeps or deferred:
            if wants_video:
                mode = DEFERRED if deferred else LIVE
                self._pending_video = run.pending_video(name, mode)
            self.stays = keeps and run.choice.keeps_without_video(kind)
            self.states = self._new_states(start, observation, name, is_kept=keeps)
        if deferred:
            assert self.states is not None
            self.video = DeferredVideo(run.directory, name, self.states)
        elif wants_video:
            live = live_videos(run, run.directory / name)
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
        """Discard everything that was recorded about the episode."""
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
            end_time: when the episode ended, in seconds since the epoch.
        """
        stats = self._run.stats
        known = {**facts, "length": stats.steps, "reward": stats.rewards}
        try:
            if self.states is not None:
                own = {"length": self.states.steps, "end_time": end_time}
                early = self.states.early_end
                if early is not None and self.states.steps < (stats.steps or 0):
                    # The trajectory ends before the episode. Readers add up the rewards
                    # of the rows that exist.
                    cut = {"complete": False, **early, "reward": None}
                    self.states.end({**cut, **own})
                else:
                    self.states.end({**known, **own})
        finally:
            if self.live is not None:
                self.live.end(known)

    def hand_on(self) -> None:
        """Submit the recording to the finisher, and its videos to the trackers."""
        self.expect()
        self._submit()

    def expect(self) -> None:
        """Arrange for trackers to be notified of the videos once they exist."""
        if self.mode is not None and self._run.trackers:
            self._run.trackers.expect(Path(str(self.video.path)))
        if self.live is not None:
            self.live.give_second_names()

    def choose(self, selection: Mapping[str, Any]) -> None:
        """Keep the video of an episode that was chosen after its end.

        Args:
            selection: why and how the episode was chosen.

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
            self._run.note("dropped", self.episode.episode_id)
        else:
            self.states.drop()

    def _submit(self) -> None:
        # Without a span, the disk was too full for a single row, so there is no video.
        if self.states is not None and self.states.is_there:
            self._run.submit(self._path)

    def _new_states(
        self, start: EpisodeStart | None, observation: Any, name: str, *, is_kept: bool
    ) -> StateRecorder:
        run = self._run
        facts: dict[str, Any] = {
            "random_state": self.episode.random_state,
            "kept": is_kept,
            "video": self._pending_video,
        }
        if self._pending_video is None and run.env.rendering.mode == DEFERRED:
            # Needed if episodes of several monitors are chosen later.
            facts["possible_video"] = run.pending_video(
                name, DEFERRED, is_only_possible=True
            )
        is_candidate = bool(run.selection) and self._pending_video is not None
        if run.selection:
            facts["candidate"] = is_candidate
        return StateRecorder(
            run,
            self._name,
            facts=facts,
            start=start,
            observation=observation if run.options.observations else None,
            # A candidate needs its own log, because it may be dropped while other
            # episodes are kept.
            is_alone=is_candidate,
        )


class KeptVideos:
    """Holds, submits or deletes recordings, as decided by a selection.

    Args:
        selection: the object that chooses the episodes that get a video.

    Attributes:
        held: the recordings of ended episodes that are neither chosen nor dropped yet.
    """

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        self.held: dict[int, EpisodeRecording] = {}
        self._is_decided = False
        # The reason why no decision could be made, and the episodes kept as a result.
        self._failure: str | None = None
        self._left: list[int] = []

    def chosen_facts(self) -> dict[str, Any]:
        """Return the facts that mark a video as chosen."""
        selection = self.selection
        facts = {"rule": selection.name, "decided": True}
        return {**facts, "finished": selection.finished}

    def settle(self) -> None:
        """Submit the recordings that are already chosen, and delete dropped ones.

        Raises:
            DirectoryNotWritable, FileNotWritten: see `EpisodeRecording.choose` and
                `drop`. A failure does not affect the other recordings.
        """
        if len(self.held) > self.selection.undecided:
            self._hand_on(list(self.held))

    def decide(self) -> None:
        """Decide on all held recordings at the end of the run.

        Raises:
            InvalidArgument: the user's function could not choose. All held episodes are
                kept, and their videos are pending or already exist.
            DirectoryNotWritable, FileNotWritten: see `settle`.
        """
        if self._is_decided or self._failure is not None:
            return
        try:
            self.selection.close()
        except InvalidArgument as error:
            self._failure = str(error)
            self._left = list(self.held)
            for recording in self.held.values():
                recording.expect()
            raise
        self._is_decided = True
        # Chosen recordings come first, so that they survive if the process is killed.
        chosen = set(self.selection.chosen)
        self._hand_on(sorted(self.held, key=lambda number: number not in chosen))

    def details(self) -> dict[str, Any]:
        """Return the facts about the final choice for the journal."""
        failure = {} if self._failure is None else {"failure": self._failure}
        return {
            "rule": self.selection.name,
            "decided": self._is_decided,
            "chosen": self.selection.chosen,
            "finished": self.selection.finished,
            "recorded": self._left or self.selection.chosen,
            **failure,
        }

    def _hand_on(self, episode_ids: Iterable[int]) -> None:
        failures = Failures()
        for episode_id in episode_ids:
            standing = self.selection.standing(episode_id)
            if standing is Standing.CANDIDATE:
                continue
            recording = self.held.pop(episode_id)
            with failures:
                if standing is Standing.CHOSEN:
                    recording.choose(self.chosen_facts())
                else:
                    recording.drop()
        failures.raise_first()

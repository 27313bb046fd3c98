# SPDX-License-Identifier: Apache-2.0
"""What is recorded of one episode: its states, its videos, or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DirectoryNotWritable
from ..formats.frame_hashes import frame_hash_path
from ..formats.monitor_directory import trajectory_prefix, video_prefix
from ..formats.video_metadata import amend_metadata
from .fast_path import FastPath, counting
from .keep_rules import Standing
from .live_videos import LiveVideos
from .monitored_run import MonitoredRun
from .options import DEFERRED, LIVE
from .recording import DeferredVideo, Recording
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart


class EpisodeRecording:
    """Records one episode, from its reset to its end, and knows what is left of it.

    Args:
        run: of which it is.
        on_picture_error: called with an error that is raised while a frame of a step
            is drawn live: it may be the environment's own.

    Attributes:
        episode_id: its number.
        video: records it (or not), live or for later.
        is_over: it has ended, and that is written down.
    """

    def __init__(
        self,
        run: MonitoredRun,
        *,
        on_picture_error: Callable[[Exception], object],
    ) -> None:
        self.episode_id = run.episode.episode_id
        self.video: VideoRecorder | DeferredVideo = run.no_video()
        self.is_over = False
        self._run = run
        self._on_picture_error = on_picture_error
        self._states: Recording | None = None
        self._live: LiveVideos | None = None
        # What the log says of the video; None where there is none.
        self._promise: Mapping[str, Any] | None = None
        # Whether there is one, and it is decided after the end whether it is kept.
        self._is_candidate = False
        # Whether the states are kept also where the video is not.
        self._stays = False

    @property
    def mode(self) -> str | None:
        """`DEFERRED` or `LIVE`; None where the episode gets no video of its own."""
        if self._live is not None:
            return LIVE
        return DEFERRED if isinstance(self.video, DeferredVideo) else None

    @property
    def size(self) -> int:
        """The bytes of what there is of it."""
        size = 0 if self._states is None else self._states.size
        for recorder in [] if self._live is None else self._live.recorders:
            files = [path for path in _files_of(recorder) if path.exists()]
            size += sum(path.stat().st_size for path in files)
        return size

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
        path = run.directory / video_prefix(run.infix, self.episode_id)
        second_name = run.second_name("episode", self.episode_id)
        if keeps or deferred:
            if wants_video:
                mode = DEFERRED if deferred else LIVE
                self._promise = run.promise(path, mode, second_name=second_name)
                self._is_candidate = bool(run.selection)
            self._stays = keeps and stays
            self._states = self._new_recording(start, observation, is_kept=keeps)
        if deferred:
            assert self._states is not None
            run.finisher.expect()
            self.video = DeferredVideo(path, self._states)
        elif wants_video:
            live = run.live_videos(
                path, second_name=second_name, on_picture_error=self._on_picture_error
            )
            self.video = live.recorders[0]
            if self.video.enabled:
                self._live = live
                live.begin()

    def give_up(self, reason: str) -> None:
        """Draw no frames, after an error at the reset; states are recorded."""
        if self._live is not None:
            self._live.give_up(reason)

    def fast_path(self) -> FastPath | None:
        """Return what the coming steps may be recorded with, if they are usual."""
        if self._live is not None:
            return None
        if self._states is None:
            return counting(self._run.stats)
        return self._states.fast_path()

    def before_step(self, action: Any) -> None:
        """Note the action of the coming step."""
        if self._states is not None:
            self._states.before_step(action)

    def step(
        self,
        reward: float,
        *,
        terminated: bool,
        truncated: bool,
        observation: Any,
        has_picture: bool,
    ) -> None:
        """Record the states of a step; as `Recording.step`."""
        if self._states is not None:
            self._states.step(
                reward,
                terminated=terminated,
                truncated=truncated,
                observation=observation,
                is_last=terminated or truncated,
                has_picture=has_picture,
            )

    def take_pictures(self, *, is_last: bool, is_there: bool) -> None:
        """Draw the frames of a step, where they are drawn live."""
        if self._live is not None:
            self._live.take(is_there=is_there, last=is_last)

    def take_last(self) -> None:
        """Take the frame of the last step, if it was left out."""
        if self.is_over:
            return
        if self._states is not None:
            self._states.take_frame()
        if self._live is not None:
            self._live.take_last()

    def discard(self) -> None:
        """Leave nothing."""
        self._discard_live()
        if self._states is not None:
            self._states.discard()
            self._states = None

    def leave(self) -> None:
        """Let go of the live videos as they are: recovery finishes them."""
        if self._live is not None:
            self._live.leave()

    def end(
        self,
        facts: Mapping[str, Any],
        standing: Standing,
        selection: Mapping[str, Any],
        *,
        end_time: float,
    ) -> None:
        """Finish the trajectory and the videos. Idempotent.

        Args:
            facts: of the episode's end.
            standing: whether the video is kept.
            selection: what is said of the choice, where it is chosen by now.
            end_time: in seconds since the epoch.
        """
        if standing is Standing.DROPPED:
            self._discard_live()
            if not self._stays:
                self.discard()
        stats = self._run.stats
        known = {**facts, "length": stats.steps, "reward": stats.rewards}
        try:
            if self._states is not None:
                said = {"length": self._states.steps, "end_time": end_time}
                verdict = self._verdict(standing, selection)
                self._states.end({**known, **verdict, **said})
        finally:
            if self._live is not None:
                if standing is Standing.CHOSEN and selection:
                    known["selection"] = selection
                self._live.end(known)
        self.is_over = True

    def hand_on(self) -> None:
        """Let others tell of the videos, draw them, and finish the trajectory."""
        self.expect()
        # Else the disk was too full for a single row: there is nothing to promise.
        if self._states is not None and self._states.is_there:
            self._run.finisher.submit(self._states.path)

    def expect(self) -> None:
        """Let others tell of the videos, once they are there."""
        if self.mode is not None and self._run.trackers:
            self._run.trackers.expect(Path(str(self.video.path)))
        if self._live is not None:
            self._live.name_again()

    def choose(self, selection: Mapping[str, Any]) -> None:
        """Keep the video of an episode that has ended before it was chosen.

        Args:
            selection: what is said of the choice.

        Raises:
            FileNotWritten: the disk is too full to say so; it is handed on all the
                same.
        """
        try:
            for recorder in [] if self._live is None else self._live.recorders:
                _say_in_metadata(recorder, selection)
            self._add_verdict(Standing.CHOSEN, selection)
        finally:
            self.hand_on()

    def drop(self) -> None:
        """Leave no video of an episode that has ended, nor states that do not stay.

        Raises:
            DirectoryNotWritable: they cannot be removed.
            FileNotWritten: the disk is too full to say of states that stay that there
                will be no video.
        """
        # The last one that was finished is the sign that all are there.
        for recorder in [] if self._live is None else reversed(self._live.recorders):
            _remove(_files_of(recorder))
        self._live = None
        if self._states is None or not self._states.is_there:
            return
        if self._stays:
            self._add_verdict(Standing.DROPPED, {})
            self._run.finisher.submit(self._states.path)
            self._run.journal.note("dropped", self.episode_id)
        else:
            self._states.remove()

    def _add_verdict(self, standing: Standing, selection: Mapping[str, Any]) -> None:
        if self._states is not None:
            self._states.add(self._verdict(standing, selection))

    def _verdict(
        self, standing: Standing, selection: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return what the log says of how the video stands, where that changes."""
        if not self._is_candidate or standing is Standing.CANDIDATE:
            return {}
        if standing is Standing.DROPPED:
            return {"candidate": False, "video": None}
        video = {**(self._promise or {}), "selection": selection}
        return {"candidate": False, "video": video}

    def _discard_live(self) -> None:
        if self._live is not None:
            self._live.discard()
            self._live = None

    def _new_recording(
        self, start: EpisodeStart | None, observation: Any, *, is_kept: bool
    ) -> Recording:
        run = self._run
        facts = {
            **run.recording_facts(start),
            "random_state": run.episode.random_state,
            "kept": is_kept,
            "video": self._promise,
        }
        if self._promise is None and run.subject.rendering.mode == DEFERRED:
            # For those who choose later, among the episodes of several monitors.
            path = run.directory / video_prefix(run.infix, self.episode_id)
            facts["possible_video"] = run.promise(path, DEFERRED, second_name={})
        if run.selection:
            facts["candidate"] = self._is_candidate
        return Recording(
            run,
            trajectory_prefix(run.infix, self.episode_id),
            logs=run.logs,
            what="trajectory",
            facts=facts,
            states=None if start is None else run.subject.states,
            start=start,
            max_fps=run.options.max_fps,
            observation=observation if run.options.observations else None,
            # It may be dropped without the others.
            is_alone=self._is_candidate,
        )


def _files_of(recorder: VideoRecorder) -> Iterator[Path]:
    """Yield the files of a live video, the metadata first.

    Where that is there, the video is: so it has to go before the others.
    """
    if recorder.metadata_path is not None and recorder.path is not None:
        yield Path(recorder.metadata_path)
        yield Path(recorder.path)
        yield frame_hash_path(Path(recorder.path))


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise DirectoryNotWritable(path.parent, error) from error


def _say_in_metadata(recorder: VideoRecorder, selection: Mapping[str, Any]) -> None:
    recorder.metadata["selection"] = dict(selection)
    amend_metadata(Path(str(recorder.path)), {"selection": selection})

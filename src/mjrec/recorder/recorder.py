# SPDX-License-Identifier: Apache-2.0
"""The recorder: told reset, step and close, it fills a monitor directory."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import os
import sys
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ..annotation import Caption
from ..errors import DirectoryNotWritable, Error, FileNotWritten
from ..formats.journal import JournalEntry
from ..formats.monitor_directory import (
    episode_of,
    journal_name,
    stats_prefix,
    trajectory_prefix,
    video_prefix,
)
from ..formats.pending_videos import note_failure, reason_of
from ..formats.span_writer import SpanLogs
from ..formats.spans import FINISHED
from ..results.listing import write_listing
from ..results.recorded_environment import GYM_VERSION
from ..simulation.state_source import EpisodeStart, StateSource
from .begun_episode import BegunEpisode
from .clip_maker import ClipMaker
from .clips import Clips
from .deferral import Deferral
from .deferred_video import DeferredVideo
from .ended_trajectories import EndedTrajectories, Rendering
from .endings import CLOSE, INTERRUPT, RESET, ending
from .episode_choice import EpisodeChoice
from .episode_trajectory import EpisodeTrajectory
from .episode_videos import EpisodeVideos
from .fast_path import FastPath, counting
from .faults import Faults, What
from .kept_videos import KeptVideos
from .live_videos import LiveVideoMaker, LiveVideos
from .opening import OpenDirectory, open_directory
from .options import DEFERRED, LIVE, RecorderOptions, type_of_mode
from .recording_facts import RecordingFacts
from .run_journal import RunJournal
from .selection import Standing
from .stats_recorder import StatsRecorder, reward_to_float
from .subject import Subject, check_pictures
from .tracking import FinishedEpisode, Run, Trackers
from .trajectory_recorder import Pace, TrajectoryRecorder
from .video_promises import VideoPromises
from .video_recorder import VideoRecorder

logger = logging.getLogger(__name__)


class Recorder:
    """Drives statistics, journal, trajectory, video and manifest of one monitor.

    It is told what happens to an environment and never calls it, except for pictures
    and states: `before_reset`, the environment's reset inside `resetting`, `reset`;
    `before_step`, the environment's step, `step`, or, while there is a `fast` path,
    what that has instead; `close`. It belongs to the process that made it.

    Args:
        directory: the monitor directory.
        subject: what is recorded.
        options: what was asked for.
        rendering: makes what renders, for the directory; None where nothing is to be
            rendered now.
        finish_log: gives the log of an ended episode its final form, where nothing
            renders.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        subject: Subject,
        options: RecorderOptions,
        rendering: Callable[[Path], Rendering] | None = None,
        finish_log: Callable[[Path], object],
    ) -> None:
        self._mode = subject.rendering.mode
        self._choice = EpisodeChoice(options, mode=self._mode)
        draws = self._choice.has_videos or options.has_clips
        if draws and self._mode == LIVE:
            check_pictures(subject)
        self._subject = subject
        self._states = subject.states
        self._clip_states = subject.clip_states
        self._options = options
        self._pid = os.getpid()
        self._is_forked = False
        _recorders.add(self)
        self._videos = EpisodeVideos()
        self._faults = Faults(
            options.on_error, lambda fault: self._journal.note("fault", fault)
        )
        # Why the running episode ends early, once the environment has raised.
        self._ending: dict[str, Any] | None = None
        # What the last step said.
        self._flags = {"terminated": False, "truncated": False}
        self._success: bool | None = None
        # The last one that is over.
        self._finished: FinishedEpisode | None = None
        env_info = {"gym_version": GYM_VERSION, "env_id": subject.env_id}
        self._place: OpenDirectory = open_directory(
            directory,
            force=options.force,
            resume=options.resume,
            uid=options.uid,
            env_info=env_info,
        )
        for states in self._all_states():
            states.open(self.directory)
        self._ended = EndedTrajectories(
            rendering(self.directory) if rendering else None, finish_log
        )
        self._kept: KeptVideos | None = None
        if self._choice.selection is not None:
            self._kept = KeptVideos(
                self._choice.selection,
                note_dropped=lambda number: self._journal.note("dropped", number),
                videos=self._videos,
                ended=self._ended,
            )
        self._next_episode_id = self._place.first_episode_id
        self._episode: BegunEpisode | None = None
        self._journal = RunJournal(
            self.directory / journal_name(self._place.infix),
            env_info=env_info,
            schedule=self._choice.schedule_name,
            keep=None if self._kept is None else self._kept.rule(),
            first_episode_id=self._place.first_episode_id,
            options=options,
            tolerates=functools.partial(self._tolerates, "journal"),
        )
        # The last episode that the journal has.
        self._journaled = -1
        self.stats_recorder = StatsRecorder(
            str(self.directory),
            stats_prefix(self._place.infix),
            env_id=subject.env_id,
            allow_early_reset=options.allow_early_reset,
        )
        self.stats_recorder.type = type_of_mode(options.mode)
        # The simulated time of the reset, where it is to be written on pictures.
        self._reset_clock: float | None = None
        self._trackers = Trackers(
            Run(
                directory=self.directory,
                infix=str(self._place.infix),
                env_id=subject.env_id,
                env_index=subject.env_index,
            ),
            options.all_trackers,
            on_fault=self._note_tracker_fault,
        )
        self._pace = Pace(
            clock=subject.clock, declared=subject.declared, max_fps=options.max_fps
        )
        self._trajectory: EpisodeTrajectory | None = None
        numbers = itertools.count()
        self._logs, self._clip_logs = (
            SpanLogs(
                self.directory,
                self._place.infix,
                numbers=numbers,
                tail_bytes=options.tail_bytes,
            )
            for _ in range(2)
        )
        self._deferral = Deferral(subject)
        self.video_recorder: VideoRecorder | DeferredVideo | None = None
        # The same, where it is drawn live, and those of further cameras.
        self._live_videos: LiveVideos | None = None
        self._live_maker = LiveVideoMaker(
            subject=subject,
            options=options,
            facts=self.live_video_facts,
            caption=self._caption,
        )
        selection = {} if self._kept is None else self._kept.facts()
        self._promises = VideoPromises(
            directory=self.directory,
            infix=self._place.infix,
            subject=subject,
            options=options,
            selection=selection,
        )
        self._facts = RecordingFacts(
            infix=str(self._place.infix), subject=subject, selection=selection
        )
        self._clips = self._new_clips() if options.has_clips else None
        self.closed = False
        # What the next step may be recorded with; None where it needs a closer look.
        self.fast: FastPath | None = None

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        return self._place.path

    @property
    def infix(self) -> str:
        """What the names of this monitor's files have in the middle."""
        return str(self._place.infix)

    @property
    def episode_id(self) -> int:
        """The number of the next episode: as in gym, it rises at each reset."""
        return self._next_episode_id

    @property
    def done(self) -> bool | None:
        """Whether the episode is over; None before the first reset."""
        return self.stats_recorder.done

    def set_mode(self, mode: str | None) -> None:
        """Set the type of the episodes from the next reset on.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: it is something else.
        """
        self.stats_recorder.type = type_of_mode(mode)

    def model_changed(self) -> None:
        """Note that textures, height fields or meshes were changed in mid-episode."""
        for states in self._all_states():
            states.model_changed()

    def forget_pictures(self) -> None:
        """Let the next episode's pictures depend on none that was made before."""
        for states in self._all_states():
            states.forget_pictures()

    def resetting(self) -> AbstractContextManager[None]:
        """Return what to put around the reset of the environment."""
        if self._states is None or self._mode == LIVE:
            return contextlib.nullcontext()
        return self._states.resetting()

    def before_reset(self) -> None:
        """Check that a reset may be made now, and take what it will overwrite.

        Raises:
            ResetNotAllowed: in mid-episode, unless early resets are allowed.
            Error: in a process forked from the one that made the recorder.
        """
        if self._is_forked:
            self._refuse_process()
        self.fast = None
        self.stats_recorder.before_reset(after_error=self._ending is not None)
        if not self._is_unbegun():
            self._take_last_picture()
        self._reset_time = time.time()
        self._random_state = None
        if self._choice.may_keep_trajectory(self.stats_recorder.type):
            self._random_state = self._subject.random_state()

    def reset(
        self, *, seed: Any = None, options: Any = None, observation: Any = None
    ) -> None:
        """Begin an episode; the environment has just been reset.

        A reset before any step of the running episode keeps its number and replaces
        its picture. One in mid-episode ends that episode's video, marked incomplete.

        Args:
            seed: the seed given to the environment's reset.
            options: the options given to it.
            observation: what it returned.

        Raises:
            PicturesDiffer: rendering was to be deferred, and cannot be.
        """
        if self._is_unbegun():
            self._next_episode_id -= 1
            self._discard_episode()
        else:
            self._end_episode(otherwise=RESET)
        self._ending = None
        self.stats_recorder.after_reset()
        self._reset_clock = self._subject.clock() if self._options.annotate else None
        self._episode = BegunEpisode(
            episode_id=self._next_episode_id,
            type=self.stats_recorder.episode_type,
            start_time=self._reset_time,
            seed=seed,
            options=options,
            random_state=self._random_state,
        )
        self._next_episode_id += 1
        try:
            self._begin_episode(self._episode, observation)
        except Exception as error:
            if not self._tolerates("video", error):
                raise
            # Where it is only the first picture, states are recorded all the same.
            if self._live_videos is not None:
                self._live_videos.give_up(str(error))
            else:
                self._begin_live_videos(self._episode.episode_id, enabled=False)
        if self._options.write_upon_reset:
            try:
                self._write_results()
            except FileNotWritten as error:
                if not self._faults.tolerates("statistics", error, episode_id=None):
                    raise

    def note_error(self, error: BaseException) -> None:
        """Note that the environment's step or reset has raised, or its user has.

        The running episode, if there is one, is marked with it, unless a later step
        succeeds. A reset is then allowed in any case. Nothing more is taken of the
        environment's state, which may be half of a step.
        """
        self.fast = None
        if self.stats_recorder.done is False and self._ending is None:
            self._ending = ending(error)

    def before_step(self, action: Any = None) -> None:
        """Check that a step may be taken now, and note its action.

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode.
            Error: in a process forked from the one that made the recorder.
        """
        stats = self.stats_recorder
        # The usual case first: this is asked at every step.
        if self._is_forked or stats.done is not False or stats.closed:
            self._refuse_step()
        if self._clips is not None:
            self._clips.before_step(stats.total_steps)
        if self._trajectory is not None:
            self._trajectory.before_step(action)

    def step(
        self,
        reward: Any,
        *,
        terminated: bool,
        truncated: bool,
        picture: bool = True,
        observation: Any = None,
        success: bool | None = None,
    ) -> None:
        """Record a step that the environment has just taken.

        Args:
            reward: a number or an array of one element.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            picture: False where the environment has reset itself already, and its
                picture belongs to the next episode.
            observation: what the step returned.
            success: at the end of an episode, what the environment says of it; None
                where it says nothing.
        """
        reward = reward_to_float(reward)
        done = bool(terminated or truncated)
        self._ending = None
        self.fast = None
        if done:
            # Before it is counted: an end that is interrupted is taken up again.
            self._flags = {
                "terminated": bool(terminated),
                "truncated": bool(truncated),
            }
            self._success = success
        self.stats_recorder.count(reward, done)
        try:
            if done:
                # First of all, so that no failing video can lose the episode.
                self._finished = self._finished_episode()
                self._journal_episode(self._finished)
        finally:
            try:
                if self._trajectory is not None:
                    self._trajectory.step(
                        reward, terminated, truncated, observation, done, picture
                    )
                if self._live_videos is not None:
                    self._live_videos.take(is_there=picture, last=done)
                if self._clips is not None:
                    self._clips.step(
                        reward,
                        terminated=bool(terminated),
                        truncated=bool(truncated),
                        is_there=picture,
                    )
            finally:
                if done:
                    self._end_episode()
                    self._tell_of_episode()
                else:
                    self.fast = self._fast_path()

    def finish(self, on_progress: Callable[[Any], None] = lambda _: None) -> None:
        """End the running episode, and wait until all videos are rendered.

        Trajectories get their final form here where nothing renders. To be called
        before `close`, which waits for nothing.

        Args:
            on_progress: called while it waits.

        Raises:
            EncoderError: the running video could not be finished.
            Error: whoever renders has failed.
        """
        if self.closed:
            return
        self._end_by_close()
        self._ended.wait(on_progress)
        try:
            self._ended.finish()
        except Error as error:
            if not self._faults.tolerates("trajectory", error, episode_id=None):
                raise

    def close(self) -> None:
        """End the episode, write statistics and manifest, and let go. Idempotent.

        Nothing is rendered any more: what is not rendered yet stays pending. An
        episode that is not over is no part of the statistics; its video is kept,
        marked incomplete. Where it is interrupted (Ctrl-C), the next call goes on.

        Raises:
            EncoderError: the video could not be finished; the rest is written.
            FileNotWritten: the disk is full; the next call tries again.
        """
        if self.closed:
            return
        self._ended.stop()
        try:
            self._end_by_close()
        except Exception:
            self._let_go()
            raise
        self._let_go()
        logger.info("Finished writing results. They are in %s.", self.directory)

    def _end_by_close(self) -> None:
        self.fast = None
        with contextlib.ExitStack() as ends:
            for logs in (self._logs, self._clip_logs):
                ends.callback(self._settle, logs.close)
            for states in self._all_states():
                # A trajectory without its model is worth nothing, and what stores it
                # may end with the process.
                ends.callback(self._finish_models, states)
            if self._kept is not None:
                ends.callback(self._settle, self._kept.decide)
            ends.callback(self._end_episode)
            self._take_last_picture()
            if self._clips is not None:
                self._clips.close(self._ending or {"reason": CLOSE})

    def _all_states(self) -> list[StateSource]:
        return [each for each in (self._states, self._clip_states) if each is not None]

    def _new_clips(self) -> Clips:
        maker = ClipMaker(
            subject=self._subject,
            promises=self._promises,
            live=self._live_maker,
            pace=self._pace,
            episode_facts=lambda start: self._facts.of_log(self._running, start),
            before=self._before_clip,
            can_be_deferred=self._deferral.is_possible,
            tolerates=functools.partial(self._tolerates, "video"),
            note=functools.partial(self._journal.note, "clip"),
            videos=self._videos,
            ended=self._ended,
            logs=self._clip_logs,
        )
        return Clips(
            length=self._options.video_length,
            trigger=self._options.step_trigger,
            make=lambda steps: maker.make(
                steps,
                episode_id=self._running.episode_id,
                total_steps=self.stats_recorder.total_steps,
            ),
        )

    def _before_clip(self) -> dict[str, Any]:
        """Return what of the running episode is not in a part that begins now."""
        stats = self.stats_recorder
        return {
            "steps_before": stats.steps or 0,
            "reward_before": stats.rewards or 0.0,
            "reset_time": self._reset_clock,
        }

    def _finish_models(self, states: StateSource) -> None:
        try:
            states.finish()
        except Error as error:
            if not self._faults.tolerates("model", error, episode_id=None):
                raise

    def add_video(self, video: VideoRecorder) -> None:
        """Let trackers know of one more video of an episode, which is closed."""
        if video.path is not None:
            self._videos.expect(Path(video.path))

    def failures(self) -> Mapping[str, str]:
        """Return why videos could not be rendered, by their names."""
        return self._ended.failures

    def _let_go(self) -> None:
        # Where it fails, all stays open, and the next close tries again. That is an
        # error in any case: no simulation is disturbed, and nothing else would say it.
        self._tell_of_videos()
        self._trackers.end()
        pending = self._write_last_results()
        self.closed = True
        self.stats_recorder.closed = True
        self._journal.close()
        self._place.lock.release()
        is_left_open = self._kept is not None and self._kept.is_left_open
        if pending and not is_left_open:
            # Said aloud: nobody else will render them.
            logger.warning(
                "%d %s pending: mjrec render %s",
                pending,
                "video" if pending == 1 else "videos",
                self.directory,
            )

    def _fast_path(self) -> FastPath | None:
        """Return what the coming steps may be recorded with, if they are usual."""
        if self._live_videos is not None or self._clips is not None:
            return None
        if self._trajectory is None:
            return counting(self.stats_recorder)
        return self._trajectory.recorder.fast_path(self.stats_recorder)

    def _refuse_step(self) -> None:
        if self._is_forked:
            self._refuse_process()
        self.stats_recorder.before_step()

    def _refuse_process(self) -> None:
        raise Error(
            f"This monitor belongs to process {self._pid}, and this is {os.getpid()}, "
            "forked from it. Two processes cannot write the same files: make the "
            "monitor inside the process that uses it."
        )

    def _is_unbegun(self) -> bool:
        """Whether the running episode has had its reset only."""
        stats = self.stats_recorder
        return stats.done is False and stats.steps == 0 and self._ending is None

    @property
    def _running(self) -> BegunEpisode:
        assert self._episode is not None, "there was no reset"
        return self._episode

    def _begin_episode(self, episode: BegunEpisode, observation: Any) -> None:
        # Those of the episode before are over, whatever the schedule raises.
        self._trajectory = self._live_videos = self.video_recorder = None
        episode_id = episode.episode_id
        wanted = self._choice.decide(episode_id)
        chosen = wanted and self._kept is None
        self._journal.run.begin(episode_id, chosen=chosen)
        self._journal.begin()
        if self._clips is not None:
            self._clips.reset(episode_id, is_chosen=wanted)
            # The episode has no video of its own.
            wanted = False
        keeps = self._choice.keeps_trajectory(
            episode_id, episode_type=episode.type, has_video=wanted
        )
        deferred = wanted and self._mode == DEFERRED
        start = None
        if self._states is not None and (keeps or deferred):
            start = self._states.begin_episode()
            deferred = deferred and self._deferral.is_possible(start)
        if keeps or deferred:
            promise = None
            if wanted:
                recording = DEFERRED if deferred else LIVE
                promise = self._promises.of_episode(episode_id, recording)
            self._trajectory = self._new_trajectory(
                episode, start, observation, promise=promise, is_kept=keeps
            )
        if deferred:
            assert self._trajectory is not None
            self._ended.expect()
            self.video_recorder = self._trajectory.deferred = DeferredVideo(
                self._promises.path(episode_id), self._trajectory.recorder
            )
        else:
            self._begin_live_videos(episode_id, enabled=wanted)

    def _begin_live_videos(self, episode_id: int, *, enabled: bool) -> None:
        recorders = self._live_maker.at(
            self._promises.path(episode_id),
            second_name=self._promises.second_name("episode", episode_id),
            enabled=enabled,
        )
        main = self.video_recorder = recorders[0]
        if not main.enabled:
            return
        self._live_videos = LiveVideos(
            recorders,
            tolerates=functools.partial(self._tolerates, "video"),
            on_picture_error=self.note_error,
        )
        self._live_videos.begin()

    def _caption(self) -> Caption:
        """Return what is written on the picture of this moment."""
        stats = self.stats_recorder
        began, now = self._reset_clock, self._subject.clock()
        return Caption(
            episode_id=self._running.episode_id,
            step=stats.steps or 0,
            time=None if began is None or now is None else now - began,
            reward=stats.rewards or 0.0,
        )

    def _new_trajectory(
        self,
        episode: BegunEpisode,
        start: EpisodeStart | None,
        observation: Any,
        *,
        promise: Mapping[str, Any] | None,
        is_kept: bool,
    ) -> EpisodeTrajectory:
        name = trajectory_prefix(self._place.infix, episode.episode_id)
        recorder = TrajectoryRecorder(
            self._logs,
            name,
            facts=self._facts.of_trajectory(
                episode, start, video=promise, is_kept=is_kept
            ),
            states=None if start is None else self._states,
            start=start,
            pace=self._pace,
            observation=observation if self._options.observations else None,
            # It may be dropped without the others.
            is_alone=self._kept is not None and promise is not None,
        )
        return EpisodeTrajectory(
            recorder,
            episode_id=episode.episode_id,
            promise=promise,
            stays=is_kept and self._choice.keeps_without_video(episode.type),
            tolerates=functools.partial(self._tolerates, "trajectory"),
        )

    def _take_last_picture(self) -> None:
        """Take the picture of the running episode's last step, if it was left out."""
        if self.stats_recorder.done is not False or self._ending is not None:
            return
        if self._trajectory is not None:
            self._trajectory.take_frame()
        if self._live_videos is not None:
            self._live_videos.take_last()

    def _finished_episode(self) -> FinishedEpisode:
        stats, episode = self.stats_recorder, self._running
        return FinishedEpisode(
            episode_id=episode.episode_id,
            length=stats.episode_lengths[-1],
            reward=stats.episode_rewards[-1],
            type=stats.episode_types[-1],
            success=self._success,
            seed=episode.seed,
            options=episode.options,
            start_time=episode.start_time,
            end_time=stats.timestamps[-1],
            total_steps=stats.total_steps,
            **self._flags,
        )

    def _journal_episode(self, episode: FinishedEpisode) -> None:
        """Write down an episode that is complete."""
        facts = {**vars(episode), **self._choice_facts(is_complete=True)}
        del facts["total_steps"]
        self._journaled = episode.episode_id
        self._journal.add(JournalEntry(**facts))

    def _journal_cut(self, facts: Mapping[str, Any]) -> None:
        """Write down an episode that is no part of the statistics."""
        episode = self._episode
        is_over = self.stats_recorder.done is not False
        if is_over or episode is None or self._journaled == episode.episode_id:
            return
        self._journaled = episode.episode_id
        cut = {"episode_id": episode.episode_id, "reason": facts.get("reason")}
        self._journal.note("cut", {**cut, **self._choice_facts(is_complete=False)})

    def _choice_facts(self, *, is_complete: bool) -> dict[str, Any]:
        """Return whether the running episode was chosen, and how it is filmed."""
        standing = self._standing(is_complete=is_complete)
        chosen = self._choice.is_scheduled and standing is Standing.CHOSEN
        recording = None
        if self._trajectory is not None and self._trajectory.deferred is not None:
            recording = DEFERRED
        elif self._live_videos is not None:
            recording = LIVE
        is_out = standing is Standing.DROPPED
        return {"chosen": chosen, "recording": None if is_out else recording}

    def _tell_of_episode(self) -> None:
        if not self._trackers:
            return
        assert self._finished is not None
        video = self.video_recorder
        is_out = self._standing(is_complete=True) is Standing.DROPPED
        has_video = video is not None and video.enabled and not is_out
        self._trackers.episode(self._finished, has_video=has_video)
        self._tell_of_videos()

    def _tell_of_videos(self) -> None:
        if self._trackers:
            self._trackers.videos(self._videos.news())

    def _note_tracker_fault(
        self, name: str, error: Exception, episode_id: int | None
    ) -> None:
        self._faults.note("tracker", f"{name}: {error}", episode_id=episode_id)

    def _tolerates(self, what: What, error: BaseException) -> bool:
        """Note what of the running episode is lost; tell whether to go on."""
        return self._faults.tolerates(what, error, episode_id=self._next_episode_id - 1)

    def _discard_episode(self) -> None:
        for videos in (self.video_recorder, self._live_videos):
            if videos is not None:
                videos.discard()
        self._discard_trajectory()

    def _discard_trajectory(self) -> None:
        trajectory, self._trajectory = self._trajectory, None
        if trajectory is not None:
            trajectory.discard()

    def _how_it_ended(self, otherwise: str) -> dict[str, Any]:
        """Return whether the running episode is complete, and what ended it."""
        if self.stats_recorder.done and self._lacks_last_step():
            # What the handler raised is on its way through here.
            return {"complete": False, **ending(sys.exception(), otherwise=INTERRUPT)}
        if self.stats_recorder.done:
            return {"complete": True, **self._flags}
        return {"complete": False, **(self._ending or {"reason": otherwise})}

    def _lacks_last_step(self) -> bool:
        """Whether a signal's handler raised before the last step's row was written."""
        steps = self.stats_recorder.steps or 0
        return self._trajectory is not None and self._trajectory.lacks(steps)

    def _standing(self, *, is_complete: bool) -> Standing:
        """Return how the running episode stands, which is over."""
        if self._kept is None or not self._choice.is_scheduled:
            # What the schedule has said is final.
            return Standing.CHOSEN
        return self._kept.judge(
            self._running.episode_id,
            self._finished_episode() if is_complete else None,
        )

    def _settle(self, do: Callable[[], None]) -> None:
        """Do something about recordings that are not decided."""
        try:
            do()
        except (DirectoryNotWritable, FileNotWritten) as error:
            if not self._tolerates("trajectory", error):
                raise

    def _end_episode(self, *, otherwise: str = CLOSE) -> None:
        """Finish the running episode's trajectory and video, if there are any.

        Args:
            otherwise: why, where it is not over and nothing was raised.
        """
        facts = self._how_it_ended(otherwise)
        standing = self._standing(is_complete=facts["complete"])
        try:
            self._journal_cut(facts)
            self._end_trajectory(facts, standing)
        finally:
            if self._live_videos is not None:
                self._end_live_videos(self._live_videos, facts, standing)
        if self._kept is not None:
            self._settle(self._kept.settle)

    def _end_trajectory(self, facts: Mapping[str, Any], standing: Standing) -> None:
        trajectory = self._trajectory
        if trajectory is None:
            return
        if standing is Standing.DROPPED and not trajectory.stays:
            self._discard_trajectory()
            return
        verdict: Mapping[str, Any] = {}
        if self._kept is not None and self._choice.is_scheduled:
            verdict = self._kept.verdict(standing, trajectory.promise or {})
        trajectory.end(
            {
                **facts,
                **verdict,
                "length": trajectory.recorder.steps,
                "reward": self.stats_recorder.rewards,
                "end_time": time.time(),
            }
        )
        self._trajectory = None
        if trajectory.is_there:
            self._hand_on(trajectory, standing)
        # Else the disk was too full for a single row: there is nothing to promise.

    def _hand_on(self, trajectory: EpisodeTrajectory, standing: Standing) -> None:
        """Let others keep, render or finish a trajectory that is whole."""
        episode_id, deferred = self._running.episode_id, trajectory.deferred
        if deferred is not None:
            deferred.close()
        if self._kept is not None and standing is Standing.CANDIDATE:
            self._kept.hold_trajectory(
                episode_id,
                trajectory.path,
                size=trajectory.recorder.size,
                promise=trajectory.promise or {},
                stays=trajectory.stays,
                deferred=deferred,
            )
            return
        if deferred is not None and standing is Standing.CHOSEN:
            self._videos.expect(Path(deferred.path))
        self._ended.add(trajectory.path)

    def _end_live_videos(
        self, videos: LiveVideos, facts: Mapping[str, Any], standing: Standing
    ) -> None:
        """Finish the videos that were drawn live; what is known goes with them."""
        if standing is Standing.DROPPED:
            videos.discard()
            return
        stats, kept = self.stats_recorder, self._kept
        known = {**facts, "length": stats.steps, "reward": stats.rewards}
        if kept is not None and standing is Standing.CHOSEN:
            known["selection"] = kept.chosen_facts()

        def list_one(recorder: VideoRecorder) -> None:
            if kept is not None and standing is Standing.CANDIDATE:
                kept.hold_live(self._running.episode_id, recorder)
            elif recorder.path is not None and "first_video" not in recorder.metadata:
                self._videos.expect(Path(recorder.path))

        try:
            videos.end(known, list_one)
        finally:
            if standing is Standing.CHOSEN:
                videos.name_again()

    def live_video_facts(self) -> dict[str, Any]:
        """Return what is known of a live video from its episode's beginning."""
        return self._facts.of_live_video(self._running)

    def _write_last_results(self) -> int:
        """Write what the run amounts to; return how many videos are pending."""
        self._journal.note_surroundings(wait=True)
        if self._kept is not None:
            self._journal.note("keep", self._kept.details())
        self._journal.note("closed", {"next_episode_id": self._next_episode_id})
        for name, why in self.failures().items():
            # Most were written down by the process that has failed.
            video = self.directory / self._video_of(name)
            if video.suffix == ".mp4" and reason_of(video) is None:
                note_failure(video, why)
        return self._write_results()

    def _video_of(self, name: str) -> str:
        """Return the name of the video of a recording, or of a video."""
        for video, clip in self._journal.run.clips.items():
            if clip.get("clip") == name:
                return video
        number = episode_of(name)
        if number is None or not name.endswith(FINISHED):
            return name
        return f"{video_prefix(self._place.infix, number)}.mp4"

    def _write_results(self) -> int:
        listing = write_listing(
            self.directory,
            self._place.infix,
            run=self._journal.run,
            stats=self.stats_recorder.stats(),
            is_own=True,
        )
        assert listing is not None, "nobody else has this monitor's lock"
        return len(listing.pending)


# Asking the system for the process's number at every step takes as long as counting it.
_recorders: weakref.WeakSet[Recorder] = weakref.WeakSet()


def _refuse_what_the_parent_made() -> None:
    for recorder in _recorders:
        recorder._is_forked = True
        recorder.fast = None


os.register_at_fork(after_in_child=_refuse_what_the_parent_made)

# SPDX-License-Identifier: Apache-2.0
"""The recorder: told reset, step and close, it fills a monitor directory."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DirectoryNotWritable, Error, FileNotWritten
from ..formats.journal import JournalEntry
from ..formats.manifest import GYM_VERSION
from ..formats.monitor_directory import (
    episode_of,
    journal_name,
    stats_prefix,
    video_prefix,
)
from ..formats.render_failures import note_failure, reason_of
from ..formats.spans import FINISHED
from ..results.manifest_and_stats import write_manifest_and_stats
from .clips import Clips
from .deferred_video import DeferredVideo
from .ending_reasons import CLOSE, INTERRUPT, RESET, ending
from .episode_choice import EpisodeChoice
from .episode_recording import EpisodeRecording
from .fast_path import FastPath
from .finishing_process import Finisher, LaterFinisher
from .keep_rules import Standing
from .kept_videos import KeptVideos
from .monitored_run import BegunEpisode, MonitoredRun
from .opening import OpenDirectory, open_directory
from .options import LIVE, RecorderOptions, type_of_mode
from .run_journal import Faults, RunJournal, facts_of
from .stats_recorder import StatsRecorder, reward_to_float
from .subject import Subject, check_pictures
from .tracking import EpisodeVideos, FinishedEpisode, Run, Trackers
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import Capture

logger = logging.getLogger(__name__)


class Recorder:
    """Drives statistics, journal, trajectories, videos and manifest of one monitor.

    It is told what happens to an environment and never calls it, except for frames and
    states: `before_reset`, the environment's reset inside `resetting`, `reset`;
    `before_step`, the environment's step, `step`, or, while there is a `fast` path,
    what that has instead; `close`. It belongs to the process that made it.

    Args:
        directory: the monitor directory.
        subject: what is recorded.
        options: what was asked for.
        finisher: makes what finishes recordings, for the directory; None where nothing
            is to be rendered now.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        subject: Subject,
        options: RecorderOptions,
        finisher: Callable[[Path], Finisher] | None = None,
    ) -> None:
        mode = subject.rendering.mode
        self._choice = EpisodeChoice(options, mode=mode)
        if mode == LIVE and (self._choice.has_videos or options.has_clips):
            check_pictures(subject)
        self._subject = subject
        self._options = options
        self._pid = os.getpid()
        self._is_forked = False
        _recorders.add(self)
        # Why the running episode ends early, once the environment has raised.
        self._ending: dict[str, Any] | None = None
        # What the last step said.
        self._flags = {"terminated": False, "truncated": False}
        self._success: bool | None = None
        # The last one that is over, and the last one that the journal has.
        self._finished: FinishedEpisode | None = None
        self._journaled = -1
        self._recording: EpisodeRecording | None = None
        self.closed = False
        # What the next step may be recorded with; None where it needs a closer look.
        self.fast: FastPath | None = None

        self._place: OpenDirectory = open_directory(
            directory,
            force=options.force,
            resume=options.resume,
            uid=options.uid,
            env_info={"gym_version": GYM_VERSION, "env_id": subject.env_id},
            facts={**facts_of(self._choice), "views": [*subject.further_views]},
        )
        self._next_episode_id = self._place.first_episode_id
        for states in self._all_states():
            states.open(self.directory)
        self._finisher = (
            LaterFinisher() if finisher is None else finisher(self.directory)
        )
        self._faults = Faults(
            options.on_error, lambda fault: self._journal.note("fault", fault)
        )
        self._journal = RunJournal(
            self.directory / journal_name(self._place.infix),
            facts=self._place.run,
            options=options,
            tolerates=lambda error: self._run.tolerates("journal", error),
        )
        self.stats_recorder = StatsRecorder(
            str(self.directory),
            stats_prefix(self._place.infix),
            env_id=subject.env_id,
            allow_early_reset=options.allow_early_reset,
        )
        self.stats_recorder.type = type_of_mode(options.mode)
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
        selection = self._choice.selection
        self._run = MonitoredRun(
            self._place,
            subject=subject,
            options=options,
            stats=self.stats_recorder,
            journal=self._journal,
            faults=self._faults,
            finisher=self._finisher,
            videos=EpisodeVideos(),
            selection={}
            if selection is None
            else {"rule": selection.name, "decided": False},
        )
        self._kept = None if selection is None else KeptVideos(self._run, selection)
        self._clips = Clips(self._run) if options.has_clips else None

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
        states = self._subject.states
        if states is None or self._subject.rendering.mode == LIVE:
            return contextlib.nullcontext()
        return states.resetting()

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
            if self._recording is not None:
                self._recording.discard()
        else:
            self._end_episode(otherwise=RESET)
        self._ending = None
        self.stats_recorder.after_reset()
        self._run.begin(
            BegunEpisode(
                episode_id=self._next_episode_id,
                type=self.stats_recorder.episode_type,
                start_time=self._reset_time,
                seed=seed,
                options=options,
                random_state=self._random_state,
                reset_clock=self._subject.clock() if self._options.annotate else None,
            )
        )
        self._next_episode_id += 1
        # That of the episode before is over, whatever the schedule raises.
        self._recording = EpisodeRecording(
            self._run, self._kept, on_picture_error=self.note_error
        )
        try:
            self._begin_episode(self._recording, observation)
        except Exception as error:
            if not self._run.tolerates("video", error):
                raise
            # Where it is only the first frame, states are recorded all the same.
            self._recording.give_up(str(error))
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
        if self._recording is not None:
            self._recording.before_step(action)

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
                if self._recording is not None:
                    self._recording.step(
                        reward,
                        terminated=terminated,
                        truncated=truncated,
                        observation=observation,
                        picture=picture,
                    )
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
        try:
            self._finisher.wait(on_progress)
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
        self._finisher.stop()
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
            for logs in (self._run.logs, self._run.clip_logs):
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

    def _all_states(self) -> list[Capture]:
        both = (self._subject.states, self._subject.clip_states)
        return [each for each in both if each is not None]

    def _finish_models(self, states: Capture) -> None:
        try:
            states.finish()
        except Error as error:
            if not self._faults.tolerates("model", error, episode_id=None):
                raise

    def add_video(self, video: VideoRecorder) -> None:
        """Let trackers know of one more video of an episode, which is closed."""
        if video.path is not None:
            self._run.videos.expect(Path(video.path))

    def failures(self) -> Mapping[str, str]:
        """Return why videos could not be rendered, by their names."""
        return self._finisher.failures

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
        if self._clips is not None or self._recording is None:
            return None
        return self._recording.fast_path()

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
    def video_recorder(self) -> VideoRecorder | DeferredVideo | None:
        """What records the running episode, or not; None before the first reset."""
        return None if self._recording is None else self._recording.video

    def _begin_episode(self, recording: EpisodeRecording, observation: Any) -> None:
        episode = self._run.episode
        wanted = self._choice.decide(episode.episode_id)
        chosen = wanted and self._kept is None
        self._journal.run.begin(episode.episode_id, chosen=chosen)
        if self._clips is not None:
            self._clips.reset(episode.episode_id, is_chosen=wanted)
            # The episode has no video of its own.
            wanted = False
        recording.begin(
            observation,
            wants_video=wanted,
            keeps=self._choice.keeps_trajectory(
                episode.episode_id, episode_type=episode.type, has_video=wanted
            ),
            stays=self._choice.keeps_without_video(episode.type),
        )

    def _take_last_picture(self) -> None:
        """Take the frame of the running episode's last step, if it was left out."""
        is_running = self.stats_recorder.done is False and self._ending is None
        if is_running and self._recording is not None:
            self._recording.take_last()

    def _finished_episode(self) -> FinishedEpisode:
        stats, episode = self.stats_recorder, self._run.episode
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
        is_over = self.stats_recorder.done is not False
        if is_over or self._journaled == self._run.episode.episode_id:
            return
        self._journaled = self._run.episode.episode_id
        cut = {"episode_id": self._journaled, "reason": facts.get("reason")}
        self._journal.note("cut", {**cut, **self._choice_facts(is_complete=False)})

    def _choice_facts(self, *, is_complete: bool) -> dict[str, Any]:
        """Return whether the running episode was chosen, and how it is filmed."""
        assert self._recording is not None
        standing = self._standing(is_complete=is_complete)
        is_out = standing is Standing.DROPPED
        return {
            "chosen": self._choice.is_scheduled and standing is Standing.CHOSEN,
            "recording": None if is_out else self._recording.mode,
        }

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
            self._trackers.videos(self._run.videos.news())

    def _note_tracker_fault(
        self, name: str, error: Exception, episode_id: int | None
    ) -> None:
        self._faults.note("tracker", f"{name}: {error}", episode_id=episode_id)

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
        return self._recording is not None and self._recording.lacks(steps)

    def _standing(self, *, is_complete: bool) -> Standing:
        """Return how the running episode stands, which is over."""
        if self._kept is None or not self._choice.is_scheduled:
            # What the schedule has said is final.
            return Standing.CHOSEN
        return self._kept.judge(
            self._run.episode.episode_id,
            self._finished_episode() if is_complete else None,
        )

    def _settle(self, do: Callable[[], None]) -> None:
        """Do something about recordings that are not decided."""
        try:
            do()
        except (DirectoryNotWritable, FileNotWritten) as error:
            if not self._run.tolerates("trajectory", error):
                raise

    def _end_episode(self, *, otherwise: str = CLOSE) -> None:
        """Finish the running episode's trajectory and video, if there are any.

        Args:
            otherwise: why, where it is not over and nothing was raised.
        """
        if self._recording is None:
            return
        facts = self._how_it_ended(otherwise)
        standing = self._standing(is_complete=facts["complete"])
        try:
            self._journal_cut(facts)
        finally:
            self._recording.end(facts, standing)
        if self._kept is not None:
            self._settle(self._kept.settle)

    def live_video_facts(self) -> dict[str, Any]:
        """Return what is known of a live video from its episode's beginning."""
        return self._run.live_facts()

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
        listing = write_manifest_and_stats(
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

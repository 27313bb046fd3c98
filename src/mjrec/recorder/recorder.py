# SPDX-License-Identifier: Apache-2.0
"""The recorder: follows reset, step and close calls and fills a monitor directory."""

from __future__ import annotations

import contextlib
import logging
import os
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

from ..errors import DirectoryNotWritable, Error, FileNotWritten
from ..formats.journal import JournalEntry
from ..formats.spans import recordings_in_flight
from ..results.manifest_writing import write_manifest_and_stats
from .clips import Clips
from .endings import CLOSE, RESET, Failures, ending
from .fast_path import FastPath
from .finishers import Finisher, LaterFinisher
from .keep_rules import Standing
from .monitored_run import MonitoredRun, RunningEpisode
from .options import DEFERRED, LIVE, RecorderOptions
from .recorded_environment import RecordedEnvironment
from .recording import EpisodeRecording, KeptVideos
from .states import DeferredVideo
from .stats_recorder import reward_to_float
from .tracking import FinishedEpisode
from .video_recorder import VideoRecorder

logger = logging.getLogger(__name__)

# Any object can be an action, even None.
UNKNOWN_ACTION: Final = object()


class Recorder:
    """Drives the statistics, journal, trajectories, videos and manifest of one monitor.

    It is notified of calls to an environment and does not call the environment, except
    for frames and states. For a reset, call `before_reset`, reset the environment
    inside `resetting`, and call `reset`. For a step, call `before_step`, step the
    environment, and call `step`. While there is a `fast` path, call its functions
    instead. At the end, call `close`. A recorder belongs to the process that created
    it.

    Args:
        directory: the monitor directory.
        env: the recorded environment.
        options: the user's options.
        finisher: creates the finisher for the directory; None if nothing will be
            rendered now.

    Attributes:
        directory: the monitor directory, absolute.
        infix: the middle part of this monitor's file names.
        episode_id: the number of the next episode; as in gym, it increases at each
            reset.
        run: the state shared by all recordings.
        stats_recorder: counts steps and rewards.
        closed: whether recording has ended.
        fast: the fast path for the next step; None if the step needs the full path.
        evaluation_facts: a function that returns the facts about the evaluation that an
            ended episode belongs to, for its journal line; None if it belongs to none.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        env: RecordedEnvironment,
        options: RecorderOptions,
        finisher: Callable[[Path], Finisher] | None = None,
    ) -> None:
        self._pid = os.getpid()
        self._is_forked = False
        _recorders.add(self)
        # Why the running episode ends early. Set when the environment raises.
        self._ending: dict[str, Any] | None = None
        self._recording: EpisodeRecording | None = None
        self.closed = False
        self.fast: FastPath | None = None
        self.evaluation_facts: Callable[[], Mapping[str, Any] | None] = lambda: None
        self.run = MonitoredRun(directory, env=env, options=options, finisher=finisher)
        selection = self.run.choice.selection
        self.directory, self.infix = self.run.directory, self.run.infix
        self.episode_id: int = self.run.events.facts["first_episode_id"]
        self.stats_recorder = self.run.stats
        self._states = [
            each for each in (env.states, env.clip_states) if each is not None
        ]
        for states in self._states:
            states.open(self.directory)
        self._kept = None if selection is None else KeptVideos(selection)
        self._clips = Clips(self.run) if options.has_clips else None
        draws_later = env.rendering.mode == DEFERRED and self._clips is None
        if draws_later and self.run.choice.will_choose(self.episode_id):
            self.run.finisher.expect()

    @property
    def done(self) -> bool | None:
        """Whether the episode is over; None before the first reset."""
        return self.stats_recorder.done

    @property
    def video_recorder(self) -> VideoRecorder | DeferredVideo | None:
        """The running episode's video recorder; None before the first reset."""
        return None if self._recording is None else self._recording.video

    @property
    def live_videos(self) -> Sequence[VideoRecorder]:
        """The recorders of the running episode's live videos, one for each camera."""
        live = None if self._recording is None else self._recording.live
        return () if live is None else live.recorders

    def bundle_trajectories(self) -> None:
        """Write all trajectories to one file when the recorder closes.

        This needs a recorder without background rendering.
        """
        assert isinstance(self.run.finisher, LaterFinisher)
        self.run.finisher.bundles = True

    def model_changed(self) -> None:
        """Note that textures, height fields or meshes have changed mid-episode."""
        for states in self._states:
            states.model_changed()

    def forget_frames(self) -> None:
        """Make the next episode's frames independent of all earlier frames."""
        for states in self._states:
            states.forget_frames()

    def resetting(self) -> AbstractContextManager[None]:
        """Return a context manager in which to reset the environment."""
        states = self.run.env.states
        if states is None or self.run.env.rendering.mode == LIVE:
            return contextlib.nullcontext()
        return states.resetting()

    def before_reset(self) -> None:
        """Check that a reset is allowed now, and record what it will overwrite.

        Raises:
            ResetNotAllowed: the episode is not over, and early resets are not allowed.
            Error: the process was forked from the one that created the recorder.
        """
        self.check_process()
        self.fast = None
        now = self.run.clock()
        self.stats_recorder.before_reset(after_error=self._ending is not None, now=now)
        if not self._is_unbegun():
            self._take_last_frame()
        self._reset_time = now
        self._random_state = None
        choice = self.run.choice
        if choice.has_videos or choice.keeps_without_video(self.stats_recorder.type):
            self._random_state = self.run.env.random_state()

    def reset(
        self, *, seed: Any = None, options: Any = None, observation: Any = None
    ) -> None:
        """Begin an episode after the environment has just been reset.

        A reset before the running episode's first step keeps the episode's number but
        replaces its frame. A reset in mid-episode ends that episode's video, which is
        marked as incomplete.

        Args:
            seed: the seed given to the environment's reset.
            options: the options given to the environment's reset.
            observation: the observation that the reset returned.

        Raises:
            PicturesDiffer: deferred rendering was requested but is impossible.
        """
        if self._is_unbegun():
            self.episode_id -= 1
            if self._recording is not None:
                self._recording.discard()
        else:
            self._cut_episode(RESET)
        self._ending = None
        self.stats_recorder.after_reset()
        env = self.run.env
        self.run.begin(
            RunningEpisode(
                episode_id=self.episode_id,
                type=self.stats_recorder.episode_type,
                start_time=self._reset_time,
                seed=seed,
                options=options,
                random_state=self._random_state,
                reset_clock=env.clock() if self.run.options.annotate else None,
            )
        )
        # The previous episode's recording is over, even if the schedule raises.
        recording = self._recording = EpisodeRecording(self.run)
        self.episode_id += 1
        try:
            self._begin_episode(recording, observation)
        except Exception as error:
            if not self.run.tolerates("video", error):
                raise
            # If only the first frame failed, states are still recorded.
            if recording.live is not None:
                recording.live.give_up(str(error))
        if self._clips is None:
            self.fast = recording.fast_path()
        if self.run.options.write_upon_reset:
            with self.run.tolerating("statistics", FileNotWritten, of_episode=False):
                self._write_results()

    def note_error(self, error: BaseException) -> None:
        """Note an exception raised by the environment's step or reset or by the caller.

        The running episode, if any, is marked with the error, unless a later step
        succeeds. A reset is always allowed afterwards. The environment's state is no
        longer recorded, because the error may have occurred in mid-step.
        """
        self.fast = None
        if self.stats_recorder.done is False and self._ending is None:
            self._ending = ending(error)

    def lose_states(self, error: Exception, *, all_rows: bool) -> None:
        """Lose the rest of the running episode's states; see `StateRecorder.lose`."""
        self.fast = None
        if self._recording is not None and self._recording.states is not None:
            self._recording.states.lose(error, all_rows=all_rows)

    def before_step(self, action: Any = UNKNOWN_ACTION) -> None:
        """Check that a step is allowed now, and note its action.

        Args:
            action: the action; left out if it is unknown.

        Raises:
            ResetNeeded: there has been no reset yet, or the episode is over.
            Error: the process was forked from the one that created the recorder.
        """
        self.check_process()
        self.stats_recorder.before_step()
        if self._clips is not None:
            self._clips.before_step()
        if action is UNKNOWN_ACTION or self._recording is None:
            return
        if self._recording.states is not None:
            self._recording.states.before_step(action)

    def step(
        self,
        reward: Any,
        *,
        terminated: bool,
        truncated: bool,
        frame: bool = True,
        observation: Any = None,
        success: bool | None = None,
    ) -> None:
        """Record a step that the environment has just taken.

        Args:
            reward: a number, or an array with one element.
            terminated: whether the task ended the episode.
            truncated: whether a limit outside the task ended it.
            frame: False if the environment has already reset itself, so that its frame
                belongs to the next episode.
            observation: the observation that the step returned.
            success: at the end of an episode, whether the environment reports success;
                None if it does not report this.
        """
        reward = reward_to_float(reward)
        done = bool(terminated or truncated)
        flags = {"terminated": bool(terminated), "truncated": bool(truncated)}
        fast, self.fast = self.fast if done else None, None
        self._ending = None
        recording, clips = self._recording, self._clips
        states = None if recording is None else recording.states
        failures = Failures()
        is_counted = False
        try:
            # Record the row first, so that a counted step has a row whenever possible.
            if fast is not None and frame:
                is_counted = fast.step(reward, **flags)
            if states is not None and not is_counted:
                states.step(
                    reward,
                    **flags,
                    observation=observation,
                    is_last=done,
                    has_frame=frame,
                )
        except Error as error:
            failures.note(error)
        except BaseException as error:
            # A signal handler has raised an exception, so this step is not recorded.
            self.note_error(error)
            raise
        if is_counted:
            self.stats_recorder.done = True
            self.stats_recorder.save_complete()
        else:
            self.stats_recorder.count(reward, done)
        if not done:
            self._take_frames(failures, reward, flags, frame)
            if clips is None and recording is not None:
                self.fast = recording.fast_path()
        else:
            self._end_episode(
                {"complete": True, **flags},
                failures,
                success=success,
                take=lambda: self._take_frames(failures, reward, flags, frame),
            )
        failures.raise_first()

    def finish(self, on_progress: Callable[[Any], None] = lambda _: None) -> None:
        """End the running episode, and wait until all videos are rendered.

        Without background rendering, this writes the trajectories in their final form.
        Call this method before `close`, which does not wait.

        Args:
            on_progress: called with the progress while waiting.

        Raises:
            EncoderError: the running video could not be finished.
            Error: rendering has failed.
        """
        if self.closed:
            return
        with self._leaving_if_interrupted():
            self._end_recordings()
        with self.run.tolerating("trajectory", Error, of_episode=False):
            self.run.finisher.wait(on_progress)

    def close(self) -> None:
        """End the episode, write the statistics and manifest, and close. Idempotent.

        Rendering stops, and videos that are not rendered yet stay pending. An
        unfinished episode is left out of the statistics. Its video is kept and marked
        as incomplete. If `close` is interrupted (Ctrl-C), the recorder is closed
        anyway: the files stay as SIGKILL would leave them, and recovery completes them.

        Raises:
            EncoderError: the video could not be finished. Everything else is written.
            FileNotWritten: the disk is full; the next call tries again.
        """
        if self.closed:
            return
        failures = Failures()
        with self._leaving_if_interrupted():
            self.run.finisher.stop()
            with failures:
                self._end_recordings()
            self.run.trackers.end()
            self.run.note_provenance(wait=True)
            if self._kept is not None:
                self.run.note("keep", self._kept.details())
            self.run.note("closed", {"next_episode_id": self.episode_id})
            pending = self._write_results()
            self._leave()
        if pending:
            what = f"{pending} {'video' if pending == 1 else 'videos'}"
            logger.warning("%s pending: mjrec render %s", what, self.directory)
        elif in_logs := len(recordings_in_flight(self.directory, self.infix)):
            what = f"{in_logs} {'trajectory' if in_logs == 1 else 'trajectories'}"
            logger.warning("%s in a log: mjrec recover %s", what, self.directory)
        failures.raise_first()
        logger.info("Finished writing results. They are in %s.", self.directory)

    def check_process(self) -> None:
        """Raise `Error` in a process forked from the one that created the recorder."""
        if self._is_forked:
            raise Error(
                f"This monitor belongs to process {self._pid}, but this is process "
                f"{os.getpid()}, forked from it. Two processes cannot write the same "
                "files. Create the monitor inside the process that uses it."
            )

    def _is_unbegun(self) -> bool:
        """Return whether the running episode has no steps yet."""
        stats = self.stats_recorder
        return stats.done is False and stats.steps == 0 and self._ending is None

    def _begin_episode(self, recording: EpisodeRecording, observation: Any) -> None:
        number = recording.episode.episode_id
        wanted = self.run.ask("video", self.run.choice.decide, number)
        recording.is_chosen = wanted
        if self._clips is not None:
            self._clips.reset(is_chosen=wanted)
        self.run.events.begin(number, chosen=wanted and self._kept is None)
        # With clips, the episode has no video of its own.
        recording.begin(observation, wants_video=wanted and self._clips is None)

    def _take_last_frame(self) -> None:
        """Take the running episode's last frame if it was left out."""
        is_running = self.stats_recorder.done is False and self._ending is None
        recording = self._recording
        if is_running and recording is not None and not recording.is_over:
            recording.take_last()

    def _take_frames(
        self, failures: Failures, reward: float, flags: Mapping[str, bool], frame: bool
    ) -> None:
        """Take the live frames of a step, and the frame for a clip."""
        live = None if self._recording is None else self._recording.live
        if live is not None:
            with failures:
                try:
                    live.take(last=any(flags.values()), is_there=frame)
                except Exception as error:
                    # The error may come from the environment itself.
                    self.note_error(error)
                    raise
        if self._clips is not None:
            with failures:
                self._clips.step(reward, **flags, has_frame=frame)

    def _cut_episode(self, reason: str) -> None:
        """End the running episode, if any, as incomplete.

        Args:
            reason: the reason to give if no exception was raised.
        """
        recording = self._recording
        if recording is None or recording.is_over:
            return
        if self.stats_recorder.done:
            # A signal arrived between the episode's last step and its end. The rows
            # show that it is complete, so recovery will finish it.
            recording.is_over = True
            self._leave_recording(recording)
            return
        failures = Failures()
        facts = {"complete": False, **(self._ending or {"reason": reason})}
        self._end_episode(facts, failures)
        failures.raise_first()

    def _leave_recording(self, recording: EpisodeRecording) -> None:
        """Leave the running episode in the state in which SIGKILL would leave it."""
        recording.leave()
        # The span may now extend to the log's last row, so the next episode needs a new
        # log.
        self.run.of_episodes.logs.release()

    def _end_episode(
        self,
        facts: Mapping[str, Any],
        failures: Failures,
        *,
        success: bool | None = None,
        take: Callable[[], None] = lambda: None,
    ) -> None:
        """End the running episode's recording, and submit, hold or drop it.

        Args:
            facts: the facts about the episode's end.
            failures: collects the errors raised here.
            success: whether the environment reports success; None if unknown.
            take: a function that takes the episode's last frames.
        """
        recording, is_complete = self._recording, facts["complete"]
        assert recording is not None, "there was no reset"
        episode_id = recording.episode.episode_id
        # A schedule's decision is final.
        kept = self._kept if recording.is_chosen else None
        known = self._results(facts, success) if is_complete else None
        episode = None
        if known is not None and (kept is not None or self.run.trackers):
            total = self.stats_recorder.total_steps
            episode = FinishedEpisode(**known, total_steps=total)
        standing = Standing.CHOSEN
        if kept is not None:
            if episode is not None:
                kept.selection.add(episode)
            standing = kept.selection.standing(episode_id)
        is_dropped = standing is Standing.DROPPED
        is_chosen = recording.is_chosen and standing is Standing.CHOSEN
        # Do this only once, even if interrupted; recovery completes the rest.
        recording.is_over = True
        try:
            # If the process is killed, an episode without its model will be useless.
            for states in self._states:
                states.settle()
            # Write this before drawing, so that no failing video loses the episode.
            with failures:
                choice: dict[str, Any] = {
                    "chosen": is_chosen,
                    "recording": None if is_dropped else recording.mode,
                }
                if known is None:
                    cut = {"episode_id": episode_id, "reason": facts["reason"]}
                    self.run.note("cut", {**cut, **choice})
                else:
                    evaluation = self.evaluation_facts()
                    entry = JournalEntry(**known, **choice, evaluation=evaluation)
                    self.run.add(entry)
            take()
            if is_dropped and not recording.stays:
                with failures:
                    recording.discard()
            else:
                if kept is not None and is_chosen and recording.live:
                    recording.live.say(selection=kept.chosen_facts())
                with failures:
                    recording.end(facts, end_time=self._end_time(facts))
                with failures:
                    if kept is None:
                        recording.hand_on()
                    else:
                        kept.held[episode_id] = recording
            if kept is not None:
                with failures, self._tolerating_lost():
                    kept.settle()
        except BaseException:
            self._leave_recording(recording)
            raise
        if episode is not None:
            has_video = recording.video.enabled and not is_dropped
            self.run.trackers.episode(episode, has_video=has_video)

    def _end_time(self, facts: Mapping[str, Any]) -> float:
        if facts["complete"]:
            return self.stats_recorder.timestamps[-1]
        return self._reset_time if facts["reason"] == RESET else self.run.clock()

    def _results(
        self, flags: Mapping[str, Any], success: bool | None
    ) -> dict[str, Any]:
        """Return the facts about a complete episode that are known at its end."""
        stats, begun = self.stats_recorder, self.run.episode
        return {
            "episode_id": begun.episode_id,
            "length": stats.episode_lengths[-1],
            "reward": stats.episode_rewards[-1],
            "type": begun.type,
            "start_time": begun.start_time,
            "end_time": stats.timestamps[-1],
            "seed": begun.seed,
            "options": begun.options,
            "terminated": flags["terminated"],
            "truncated": flags["truncated"],
            "success": success,
        }

    def _end_recordings(self) -> None:
        """End all running recordings, even if some of them fail. Idempotent."""
        self.fast = None
        failures = Failures()
        with failures:
            if self._clips is not None:
                self._clips.close(self._ending or {"reason": CLOSE})
        with failures:
            self._take_last_frame()
        with failures:
            self._cut_episode(CLOSE)
        if self._kept is not None:
            with failures, self._tolerating_lost():
                self._kept.decide()
        with failures:
            self.finish_models()
        with failures, self._tolerating_lost():
            self.run.close_logs()
        failures.raise_first()

    def finish_models(self) -> None:
        """Wait until every model is stored.

        A trajectory without its model is useless, and the thread that stores models may
        end with the process.

        Raises:
            FileNotWritten: a model could not be stored, and `on_error` does not
                tolerate that.
        """
        failures = Failures()
        for states in self._states:
            with failures, self.run.tolerating("model", Error, of_episode=False):
                states.finish()
        failures.raise_first()

    def _tolerating_lost(self) -> AbstractContextManager[None]:
        return self.run.tolerating("trajectory", DirectoryNotWritable, FileNotWritten)

    @contextlib.contextmanager
    def _leaving_if_interrupted(self) -> Iterator[None]:
        """Release all files if the block is interrupted, but not after an error."""
        try:
            yield
        except Exception:
            raise
        except BaseException:
            self._leave()
            logger.warning(
                "The recording was interrupted while it was closing. To complete it, "
                "run: mjrec recover %s",
                self.directory,
            )
            raise

    def _leave(self) -> None:
        """Release all files as they are, as if this process had ended."""
        self.closed = self.stats_recorder.closed = True
        self.run.finisher.stop()
        for each in (self._recording, self._clips):
            if each is not None:
                each.leave()
        self.run.leave()

    def _write_results(self) -> int:
        """Write the statistics and manifest; return the number of pending videos."""
        listing = write_manifest_and_stats(
            self.directory,
            self.run.infix,
            run=self.run.events,
            stats=self.stats_recorder.stats(),
            is_own=True,
        )
        assert listing is not None, "no other process has this monitor's lock"
        return len(listing.pending)


# Calling os.getpid() at every step would take as long as counting the step.
_recorders: weakref.WeakSet[Recorder] = weakref.WeakSet()


def _refuse_what_the_parent_made() -> None:
    for recorder in _recorders:
        recorder._is_forked = True
        recorder.fast = None


os.register_at_fork(after_in_child=_refuse_what_the_parent_made)

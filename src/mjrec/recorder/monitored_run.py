# SPDX-License-Identifier: Apache-2.0
"""The state that all recordings of a run share: the journal, the logs and the facts."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ..annotation import Caption
from ..atomic_files import file_sha256
from ..errors import FileNotWritten
from ..formats.journal import JournalEntry, JournalWriter
from ..formats.manifest import GYM_VERSION
from ..formats.monitor_directory import (
    VideoName,
    further_parts,
    journal_name,
    stats_prefix,
)
from ..formats.span_writer import SpanLogs
from ..formats.video_metadata import recording_facts
from ..machine import machine_fingerprint
from ..provenance import look_around, versions
from ..results.run import Run
from . import tracking
from .episode_choice import EpisodeChoice
from .finishers import Finisher, LaterFinisher
from .opening import open_directory
from .options import LIVE, OFF, WARN, RecorderOptions, type_of_mode
from .recorded_environment import RecordedEnvironment, check_frames, check_refusal
from .stats_recorder import StatsRecorder
from .step_arrays import StepArray
from .tracking import Trackers
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import Capture, EpisodeStart

logger = logging.getLogger(__name__)


class RunningEpisode(NamedTuple):
    """The facts about an episode that are known when it begins.

    Attributes:
        episode_id: the episode's number.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: time just before the reset, in seconds since the Unix epoch.
        seed: the seed given to `reset`.
        options: the options given to `reset`.
        random_state: state of the environment's random number generator before the
            reset, as JSON values; None if unknown or not needed.
        reset_clock: simulated time at the reset, if frames show the time.
    """

    episode_id: int
    type: str
    start_time: float
    seed: Any
    options: Any
    random_state: Any
    reset_clock: float | None


@dataclass
class Track:
    """The capture and the logs for either the episodes or the clips of a run.

    Attributes:
        logs: the logs for the rows.
        capture: captures the states; None if no simulation is accessible.
        action: the buffer for actions that the last recording used.
        pace: the rate, timestep and stride of the last recording; None before the
            first recording.
    """

    logs: SpanLogs
    capture: Capture | None
    action: StepArray | None = None
    pace: Mapping[str, Any] | None = None


What = Literal["video", "trajectory", "statistics", "journal", "model", "tracker"]


class MonitoredRun:
    """The state shared by all recordings of a run, and the facts for their files.

    It writes the run's journal. With `on_error="raise"`, the caller raises an error for
    each fault, and the manifest lists those of a full disk. With `on_error="warn"`, a
    fault is logged once and listed in the manifest, and the simulation continues.

    Args:
        directory: the monitor directory, in which the run claims an infix.
        env: the recorded environment.
        options: the user's options.
        finisher: creates the finisher that processes ended recordings; None if nothing
            will be rendered now.

    Raises:
        NoPictures: see `check_frames`.
        Error: see `open_directory`.

    Attributes:
        env: the recorded environment.
        options: the user's options.
        choice: decides what to record when an episode begins.
        stats: the recorder that counts steps and rewards.
        finisher: the finisher that processes ended recordings.
        selection: facts for videos that are chosen after their episodes have ended;
            empty if videos are chosen when episodes begin.
        directory: the monitor directory, absolute.
        infix: the middle part of the monitor's file names.
        clock: a function that returns the time in seconds since the Unix epoch.
        events: the journal's content so far, including events that could not be written
            because the disk was full.
        trackers: the trackers, which are notified of episodes and finished videos.
        of_episodes: the track for episodes.
        of_clips: the track for clips.
        no_video: a disabled recorder for episodes without a video.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        env: RecordedEnvironment,
        options: RecorderOptions,
        finisher: Callable[[Path], Finisher] | None,
    ) -> None:
        self.env, self.options, self.clock = env, options, options.clock
        mode = env.rendering.mode
        choice = self.choice = EpisodeChoice(options, draws=mode != OFF)
        if mode == LIVE and (choice.has_videos or options.has_clips):
            check_frames(env)
        rule = None if choice.selection is None else choice.selection.name
        # Absolute, so that a later chdir does not scatter the files.
        self.directory = Path(directory).absolute()
        self.infix, self._lock, facts = open_directory(
            self.directory,
            options,
            {
                "env_info": {"gym_version": GYM_VERSION, "env_id": env.env_id},
                "schedule": choice.schedule_name,
                "keep": None if rule is None else {"rule": rule},
                "versions": dict(versions()),
                "views": further_parts(env.cameras) or list(env.further_frames),
                "environment": env.environment,
                "options": {**options.recorded(), **env.view},
            },
        )
        self.stats = StatsRecorder(
            self.directory,
            stats_prefix(self.infix),
            env_id=env.env_id,
            allow_early_reset=options.allow_early_reset,
        )
        self.stats.type = type_of_mode(options.mode)
        self.stats.clock = self.clock
        self.finisher = (
            LaterFinisher() if finisher is None else finisher(self.directory)
        )
        self.selection = {} if rule is None else {"rule": rule, "decided": False}
        self.events = Run(facts)
        path = self.directory / journal_name(self.infix)
        self._journal = JournalWriter(path, run=facts)
        self._faults: set[tuple[int | None, What, str]] = set()
        self._policy = _policy_facts(options)
        self._statements = options.statements
        # The number of journal lines after the first line.
        self._lines = 0
        self._provenance = None if options.statements else look_around()
        self._environment_facts = {
            "infix": self.infix,
            "env_id": env.env_id,
            "environment": env.environment,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
        }
        self.trackers = Trackers(
            tracking.Run(
                directory=self.directory,
                infix=self.infix,
                env_id=env.env_id,
                env_index=env.env_index,
            ),
            options.all_trackers,
            on_fault=lambda name, error, number: self.note_fault(
                "tracker", f"{name}: {error}", episode_id=number
            ),
        )
        numbers = itertools.count()
        self.of_episodes, self.of_clips = self._tracks = [
            Track(
                SpanLogs(
                    self.directory,
                    self.infix,
                    journal=self._journal,
                    numbers=numbers,
                    tail_bytes=options.tail_bytes,
                ),
                capture,
            )
            for capture in (env.states, env.clip_states)
        ]
        # Functions to call when the run closes, because the disk was full.
        self._late: list[Callable[[], None]] = []
        self.no_video = VideoRecorder(env.frames, enabled=False)
        self._episode: RunningEpisode | None = None
        # The reasons for drawing videos live that have been logged so far.
        self._said: set[str] = set()

    # --- the journal -----------------------------------------------------------------

    def add(self, entry: JournalEntry) -> None:
        """Write a completed episode to the journal.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.events.add(entry)
        self._write(self._journal.append, entry)
        self.note_provenance()

    def note(self, kind: str, facts: Any) -> None:
        """Write an event to the journal.

        Args:
            kind: the kind of the event, from `formats.journal.EVENTS`.
            facts: the facts about the event.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.events.note(kind, facts)
        self._write(self._journal.note, kind, facts)

    def note_provenance(self, *, wait: bool = False) -> None:
        """Write the run's provenance to the journal if it is known by now.

        Args:
            wait: whether to wait briefly for the provenance.
        """
        if self.events.provenance is None:
            found = self._found(wait=wait)
            if found is not None:
                self.note("provenance", found)

    def tolerates(
        self, what: What, error: BaseException, *, of_episode: bool = True
    ) -> bool:
        """Record a fault, and return whether the simulation may continue.

        If it may not, only a full disk is recorded; the caller raises the error.

        Args:
            what: the part of the recording that failed, such as "video".
            error: the reason.
            of_episode: whether the fault belongs to the running episode.
        """
        has_episode = of_episode and self._episode is not None
        episode_id = self.episode.episode_id if has_episode else None
        is_warned = self.options.on_error == WARN
        if not (is_warned or isinstance(error, FileNotWritten)):
            return False
        is_new = False
        # The error to raise is the first one, not that the journal has no room either.
        with contextlib.suppress(FileNotWritten):
            is_new = self.note_fault(what, str(error), episode_id=episode_id)
        if is_new and is_warned:
            of = "" if episode_id is None else f" of episode {episode_id}"
            logger.warning("Incomplete recording: %s%s. %s", what, of, error)
        return is_warned

    def ask(self, what: What, choose: Callable[..., Any], *about: Any) -> bool:
        """Return the decision of a user's function, which may raise any exception.

        Args:
            what: the part of the recording that is lost if the function raises.
            choose: the function.
            *about: the function's arguments.

        Returns:
            The decision; False if the function raised and `on_error` tolerates that.
        """
        try:
            return bool(choose(*about))
        except Exception as error:
            if not self.tolerates(what, error):
                raise
            return False

    @contextlib.contextmanager
    def tolerating(
        self, what: What, *kinds: type[Exception], of_episode: bool = True
    ) -> Iterator[None]:
        """Suppress errors of the given types if `on_error` tolerates them."""
        try:
            yield
        except kinds as error:
            if not self.tolerates(what, error, of_episode=of_episode):
                raise

    def note_fault(self, what: What, reason: str, *, episode_id: int | None) -> bool:
        """Write a fault to the journal, and return whether it is new."""
        fault = (episode_id, what, reason)
        if fault in self._faults:
            return False
        self._faults.add(fault)
        facts = {"episode_id": episode_id, "what": what, "reason": reason}
        self.note("fault", facts)
        return True

    def submit(self, recording: Path) -> None:
        """Submit a recording to the finisher once its end is in the journal."""
        if self._journal.is_behind:
            self.retry_at_close(functools.partial(self.finisher.submit, recording))
        else:
            self.finisher.submit(recording)

    def retry_at_close(self, do: Callable[[], None]) -> None:
        """Postpone a call until `close_logs`, because the disk is full."""
        self._late.append(do)

    def close_logs(self) -> None:
        """Write the remaining rows and facts to the logs, and make the postponed calls.

        Raises:
            FileNotWritten: the disk is full. The next call tries again.
        """
        for track in self._tracks:
            track.logs.close()
        late, self._late = self._late, []
        try:
            while late:
                late.pop(0)()
        finally:
            self._late += late

    def leave(self) -> None:
        """Release the journal, the logs and the lock as they are. Idempotent."""
        for track in self._tracks:
            track.logs.release()
        self._journal.close()
        self._lock.release()

    def _found(self, *, wait: bool) -> Mapping[str, Any] | None:
        if (stated := self._statements) is not None:
            is_time = wait or self._lines >= stated.provenance_after
            return stated.provenance if is_time else None
        found = None if self._provenance is None else self._provenance.found(wait=wait)
        return None if found is None else {**found, **self._policy}

    def _note_stated_faults(self) -> None:
        stated = () if self._statements is None else self._statements.faults
        for lines, facts in stated:
            if lines == self._lines:
                self.note("fault", facts)
                return

    def _write(self, write: Callable[..., None], *line: Any) -> None:
        self._lines += 1
        try:
            write(*line)
        except FileNotWritten as error:
            if not self.tolerates("journal", error):
                raise
        self._note_stated_faults()

    # --- facts -----------------------------------------------------------------------

    @property
    def episode(self) -> RunningEpisode:
        """The running episode."""
        assert self._episode is not None, "there was no reset"
        return self._episode

    def begin(self, episode: RunningEpisode) -> None:
        """Begin an episode. Subsequent faults are attributed to this episode."""
        self._episode = episode
        self.events.begin(episode.episode_id, chosen=False)
        self._note_stated_faults()

    def caption(self) -> Caption:
        """Return the caption for the current frame."""
        began, now = self.episode.reset_clock, self.env.clock()
        return Caption(
            episode_id=self.episode.episode_id,
            step=self.stats.steps or 0,
            time=None if began is None or now is None else now - began,
            reward=self.stats.rewards or 0.0,
        )

    def can_be_deferred(self, start: EpisodeStart) -> bool:
        """Return whether frames can be rendered from the states that follow `start`.

        Each reason why frames cannot be rendered later is logged once.

        Raises:
            PicturesDiffer, NoPictures: see `check_refusal`.
        """
        refusal = start.refusal
        if refusal is None:
            return True
        check_refusal(self.env, refusal)
        if refusal not in self._said:
            self._said.add(refusal)
            logger.warning(
                "The videos of %s are drawn live: %s.", self.env.env_id, refusal
            )
        return False

    def pending_video(
        self, name: str, recording: str, *, is_only_possible: bool = False
    ) -> dict[str, Any]:
        """Return the facts about a video to store in its trajectory or clip.

        Args:
            name: the video's file name without the extension.
            recording: when the video is drawn, `DEFERRED` or `LIVE`.
            is_only_possible: whether the video is merely possible, not planned.
        """
        options, env = self.options, self.env
        pending: dict[str, Any] = {
            "name": f"{name}.mp4",
            "quality": options.quality,
            "fps": None if options.fps is None else str(options.fps),
            "max_fps": None if options.max_fps is None else str(options.max_fps),
            "recording": recording,
            "reason": env.rendering.reason if recording == LIVE else None,
        }
        if env.cameras:
            pending["cameras"] = list(env.cameras)
            pending["tiled"] = options.tiled
        if options.annotate:
            pending["annotate"] = True
        if self.selection:
            pending["selection"] = self.selection
        return pending if is_only_possible else {**pending, **self.second_name(name)}

    def second_name(self, name: str) -> dict[str, str]:
        """Return the second name of a video, for its metadata.

        The result is empty if `name_prefix` is not set.

        Args:
            name: the video's file name without the extension.
        """
        prefix = self.options.name_prefix
        video = None if prefix is None else VideoName.parse(f"{name}.mp4")
        if video is None:
            return {}
        what, number = "episode", video.episode_id
        if video.first_step is not None:
            what, number = "step", video.first_step
        return {"also_named": f"{prefix}-{what}-{number}.mp4"}

    def recording_facts(self, start: EpisodeStart | None) -> dict[str, Any]:
        """Return the facts about the running episode, for a recording of states.

        Args:
            start: the start of the states; None if no states are recorded.
        """
        episode = self.episode
        return {
            **self._environment_facts,
            "episode_id": episode.episode_id,
            "type": episode.type,
            "start_time": episode.start_time,
            "seed": episode.seed,
            "options": episode.options,
            "model": None if start is None else start.model,
            "scene": None if start is None else start.scene,
            "refusal": None if start is None else start.refusal,
        }

    def live_facts(self) -> dict[str, Any]:
        """Return the facts about the running episode, for a live video's metadata."""
        known = self.recording_facts(None)
        video: dict[str, Any] = {"reason": self.env.rendering.reason}
        if self.selection:
            video["selection"] = self.selection
        said = recording_facts({**known, "video": video}, recording=LIVE)
        return {**said, "machine": known["machine"]}


def _policy_facts(options: RecorderOptions) -> dict[str, Any]:
    if options.policy_file is None:
        return {"policy": None}
    path = Path(options.policy_file).absolute()
    return {"policy": {"file": str(path), "sha256": file_sha256(path)}}

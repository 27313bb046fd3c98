# SPDX-License-Identifier: Apache-2.0
"""What all recordings of one run share: its journal, its logs, and its facts."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..annotation import Caption
from ..atomic_files import file_sha256
from ..errors import FileNotWritten
from ..formats.journal import JournalEntry, JournalWriter
from ..formats.monitor_directory import journal_name
from ..formats.span_writer import SpanLogs
from ..formats.video_metadata import recording_facts
from ..machine import machine_fingerprint
from ..provenance import look_around, versions
from ..results.run import Run
from . import tracking
from .finishers import Finisher
from .opening import OpenDirectory
from .options import LIVE, WARN, RecorderOptions
from .recorded_environment import RecordedEnvironment, check_refusal
from .stats_recorder import StatsRecorder
from .step_arrays import RowLayout
from .tracking import Trackers
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart

logger = logging.getLogger(__name__)

What = Literal["video", "trajectory", "statistics", "journal", "model", "tracker"]


@dataclass(frozen=True, kw_only=True)
class BegunEpisode:
    """What is known of an episode when it begins.

    Attributes:
        episode_id: its number.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall clock just before the reset, in seconds since the epoch.
        seed: as given to `reset`.
        options: as given to `reset`.
        random_state: of the environment's generator before the reset, for JSON; None
            where it is not known or not needed.
        reset_clock: the simulated time of the reset, where it is written on frames.
    """

    episode_id: int
    type: str
    start_time: float
    seed: Any
    options: Any
    random_state: Any = None
    reset_clock: float | None = None


class MonitoredRun:
    """What all recordings of one run share, and what files say of them.

    It writes the run's journal. With `on_error="raise"` a fault is an error that the
    caller raises; with "warn" it is one warning and a line in the manifest, and the
    simulation goes on.

    Args:
        place: the open directory.
        env: what is recorded.
        options: what was asked for.
        stats: counts steps and rewards.
        finisher: takes over recordings that have ended.
        selection: what is said of a video that is chosen after its episode's end; empty
            where it is chosen before.

    Attributes:
        env, options, stats, finisher, selection: as given.
        directory: the monitor directory.
        infix: what its files have in the middle.
        clock: returns the time, in seconds since the epoch.
        events: what the journal says so far, also what the disk was too full for.
        trackers: get episodes and finished videos.
        logs: of the episodes' rows.
        clip_logs: of the clips'.
        layouts, paces: of the last recording in each of these.
        no_video: stands for the video of an episode that gets none.
    """

    def __init__(
        self,
        place: OpenDirectory,
        *,
        env: RecordedEnvironment,
        options: RecorderOptions,
        stats: StatsRecorder,
        finisher: Finisher,
        selection: Mapping[str, Any],
    ) -> None:
        self.directory, self.infix = place.path, place.infix
        self.env, self.options, self.stats = env, options, stats
        self.clock = options.clock
        self.finisher, self.selection = finisher, selection
        self.events = Run(place.run)
        path = self.directory / journal_name(self.infix)
        self._journal = JournalWriter(path, run=place.run)
        self._faults: set[tuple[int | None, What, str]] = set()
        self._policy = _policy_facts(options)
        self._statements = options.statements
        # In the journal, after the first.
        self._lines = 0
        self._provenance = None if options.statements else look_around()
        self._environment_facts = {
            "infix": str(self.infix),
            "env_id": env.env_id,
            "environment": env.environment,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
        }
        self.trackers = Trackers(
            tracking.Run(
                directory=self.directory,
                infix=str(self.infix),
                env_id=env.env_id,
                env_index=env.env_index,
            ),
            options.all_trackers,
            on_fault=lambda name, error, number: self.note_fault(
                "tracker", f"{name}: {error}", episode_id=number
            ),
        )
        numbers = itertools.count()
        self.logs, self.clip_logs = (
            SpanLogs(
                self.directory,
                self.infix,
                journal=self._journal,
                numbers=numbers,
                tail_bytes=options.tail_bytes,
            )
            for _ in range(2)
        )
        self.layouts: dict[SpanLogs, RowLayout] = {}
        self.paces: dict[SpanLogs, Mapping[str, Any]] = {}
        # Recordings whose ends are not in the journal yet: the disk was full.
        self._late: list[Path] = []
        self.no_video = VideoRecorder(env.frames, enabled=False)
        self._episode: BegunEpisode | None = None
        # Why videos are drawn live, as far as it was said.
        self._said: set[str] = set()

    # --- the journal -----------------------------------------------------------------

    def add(self, entry: JournalEntry) -> None:
        """Write down a completed episode.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.events.add(entry)
        self._lines += 1
        self._write(lambda: self._journal.append(entry))
        self.note_provenance()

    def note(self, kind: str, facts: Any) -> None:
        """Write down another event, one of `formats.journal.EVENTS`.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.events.note(kind, facts)
        self._lines += 1
        self._write(lambda: self._journal.note(kind, facts))

    def note_provenance(self, *, wait: bool = False) -> None:
        """Write down what the run is made with, once that is known.

        Args:
            wait: wait for it a little.
        """
        if self.events.provenance is None:
            found = self._found(wait=wait)
            if found is not None:
                self.note("provenance", found)

    def tolerates(
        self, what: What, error: BaseException, *, of_episode: bool = True
    ) -> bool:
        """Note a fault, and tell whether the simulation may go on.

        Args:
            what: could not be recorded.
            error: why.
            of_episode: False where it is not the running episode's.
        """
        has_episode = of_episode and self._episode is not None
        episode_id = self.episode.episode_id if has_episode else None
        is_warned = self.options.on_error == WARN
        if is_warned and self.note_fault(what, str(error), episode_id=episode_id):
            of = "" if episode_id is None else f" of episode {episode_id}"
            logger.warning("Not recorded whole: %s%s. %s", what, of, error)
        return is_warned

    @contextlib.contextmanager
    def tolerating(
        self, what: What, *kinds: type[Exception], of_episode: bool = True
    ) -> Iterator[None]:
        """Go on after an error of these kinds, where it is tolerated."""
        try:
            yield
        except kinds as error:
            if not self.tolerates(what, error, of_episode=of_episode):
                raise

    def note_fault(self, what: What, reason: str, *, episode_id: int | None) -> bool:
        """Write a fault down; return whether it is a new one."""
        fault = (episode_id, what, reason)
        if fault in self._faults:
            return False
        self._faults.add(fault)
        facts = {"episode_id": episode_id, "what": what, "reason": reason}
        self.note("fault", facts)
        return True

    def submit(self, recording: Path) -> None:
        """Let a recording be finished, now or when the journal says that it ended."""
        if self._journal.is_behind:
            self._late.append(recording)
        else:
            self.finisher.submit(recording)

    def close_logs(self) -> None:
        """Write all rows, and what else the logs lack.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        self.logs.close()
        self.clip_logs.close()
        while self._late:
            self.finisher.submit(self._late.pop(0))

    def leave(self) -> None:
        """Let go of journal and logs as they are; idempotent."""
        for logs in (self.logs, self.clip_logs):
            logs.release()
        self._journal.close()

    def _found(self, *, wait: bool) -> Mapping[str, Any] | None:
        if (stated := self._statements) is not None:
            is_time = wait or self._lines >= stated.provenance_after
            return stated.provenance if is_time else None
        found = None if self._provenance is None else self._provenance.found(wait=wait)
        return None if found is None else {**found, **self._policy}

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except FileNotWritten as error:
            if not self.tolerates("journal", error):
                raise

    # --- facts -----------------------------------------------------------------------

    @property
    def episode(self) -> BegunEpisode:
        """The running episode."""
        assert self._episode is not None, "there was no reset"
        return self._episode

    def begin(self, episode: BegunEpisode) -> None:
        """Take note of an episode that begins: faults are its own from here on."""
        self._episode = episode
        self.events.begin(episode.episode_id, chosen=False)

    def caption(self) -> Caption:
        """Return what is written on the frame of this moment."""
        began, now = self.episode.reset_clock, self.env.clock()
        return Caption(
            episode_id=self.episode.episode_id,
            step=self.stats.steps or 0,
            time=None if began is None or now is None else now - began,
            reward=self.stats.rewards or 0.0,
        )

    def can_be_deferred(self, start: EpisodeStart) -> bool:
        """Return whether frames can be made from the states that begin with `start`.

        Why not is said once.

        Raises:
            PicturesDiffer, NoPictures: as `check_refusal`.
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
        self, name: str, recording: str, *, second_name: Mapping[str, str]
    ) -> dict[str, Any]:
        """Return what a trajectory, or a clip, says of its video.

        Args:
            name: of its file, without the ending.
            recording: when it is drawn, `DEFERRED` or `LIVE`.
            second_name: as of `second_name`.
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
        return {**pending, **second_name}

    def second_name(self, what: str, number: int) -> dict[str, str]:
        """Return what a video is called besides, for its metadata.

        Args:
            what: it begins with, "episode" or "step".
            number: of that.
        """
        prefix = self.options.name_prefix
        if prefix is None:
            return {}
        return {"also_named": f"{prefix}-{what}-{number}.mp4"}

    def recording_facts(self, start: EpisodeStart | None) -> dict[str, Any]:
        """Return what any recording of states says of the running episode.

        Args:
            start: of the states; None where there are none.
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
        """Return what the metadata of a live video says of the running episode."""
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

# SPDX-License-Identifier: Apache-2.0
"""What all recordings of one run share: episodes and clips, deferred and live."""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..annotation import Caption
from ..errors import Error
from ..formats.monitor_directory import ClipPart, Infix
from ..formats.span_writer import SpanLogs
from ..formats.spans import is_in_flight
from ..formats.video_names import second_name_of
from ..machine import machine_fingerprint
from ..provenance import versions
from .live_videos import LiveVideos
from .opening import OpenDirectory
from .options import LIVE, RecorderOptions
from .run_journal import RunJournal, What
from .stats_recorder import StatsRecorder
from .step_arrays import StepArray
from .subject import EpisodePictures, Subject, check_refusal
from .tracking import Trackers
from .video_recorder import VideoRecorder

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart

logger = logging.getLogger(__name__)


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


class Finisher(Protocol):
    """Turns ended recordings into trajectories and videos, beside the simulation."""

    def expect(self) -> None:
        """Get ready: a recording will come that has a video. Never waits."""

    def submit(self, recording: Path) -> None:
        """Take over an ended trajectory, or a clip by its first part. Never waits."""

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Return when all that was taken over is done."""

    def stop(self) -> None:
        """Stop at once; the rest stays pending. Idempotent."""

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos could not be rendered, by the base names of the videos."""


class LaterFinisher:
    """Draws nothing; makes the trajectories when the monitor closes.

    It is a `Finisher` for runs whose videos are rendered another time, or never.
    """

    def __init__(self) -> None:
        self.failures: Mapping[str, str] = {}
        self._waiting: list[Path] = []

    def expect(self) -> None:
        """Do nothing."""

    def submit(self, recording: Path) -> None:
        """Keep a trajectory in mind; clips stay as they are."""
        if ClipPart.parse(recording.name) is None:
            self._waiting.append(recording)

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Make the trajectories.

        Raises:
            Error: of the last that could not be made; the others are there.
        """
        # Not at the top: it loads h5py, which the simulation has no use for.
        from ..formats.trajectory_file import finish_trajectory

        failure: Error | None = None
        waiting, self._waiting = self._waiting, []
        for recording in waiting:
            try:
                if is_in_flight(recording):
                    finish_trajectory(recording)
            except Error as error:
                failure = error
                self._waiting.append(recording)
        if failure is not None:
            raise failure

    def stop(self) -> None:
        """Do nothing."""


class MonitoredRun:
    """What all recordings of one run share, and what files say of them.

    Args:
        place: the open directory.
        subject: what is recorded.
        options: what was asked for.
        stats: counts steps and rewards.
        journal: of the run.
        finisher: takes over recordings that have ended.
        trackers: are told of finished videos.
        selection: `selection` of a video that is chosen after its episode's end; empty
            where it is chosen before.

    Attributes:
        subject, options, stats, journal, finisher, trackers, selection: as given.
        directory: the monitor directory.
        infix: what its files have in the middle.
        clock: returns the time, in seconds since the epoch.
        logs: of the episodes' rows.
        clip_logs: of the clips'.
        action, row_words: what the next recording may use again of the last one.
    """

    def __init__(
        self,
        place: OpenDirectory,
        *,
        subject: Subject,
        options: RecorderOptions,
        stats: StatsRecorder,
        journal: RunJournal,
        finisher: Finisher,
        trackers: Trackers,
        selection: Mapping[str, Any],
    ) -> None:
        self.directory: Path = place.path
        self.infix: Infix = place.infix
        self.subject = subject
        self.options = options
        self.clock = options.clock
        self.stats = stats
        self.journal = journal
        self.finisher = finisher
        self.trackers = trackers
        self.selection = selection
        numbers = itertools.count()
        self.logs, self.clip_logs = (
            SpanLogs(
                place.path,
                place.infix,
                numbers=numbers,
                tail_bytes=options.tail_bytes,
            )
            for _ in range(2)
        )
        # Of the last recording, which the next one's are usually like: the memory of
        # actions, and the words of a row with those of the state before them.
        self.action: StepArray | None = None
        self.row_words: tuple[object, object, NDArray[np.intp]] | None = None
        self._no_video = VideoRecorder(subject.pictures, enabled=False)
        self._episode: BegunEpisode | None = None
        # Why videos are drawn live, as far as it was said.
        self._said: set[str] = set()

    @property
    def episode(self) -> BegunEpisode:
        """The running episode."""
        assert self._episode is not None, "there was no reset"
        return self._episode

    def begin(self, episode: BegunEpisode) -> None:
        """Take note of an episode that begins."""
        self._episode = episode
        self.journal.begin(episode.episode_id)

    def tolerates(self, what: What, error: BaseException) -> bool:
        """Note what of the running episode is lost; tell whether to go on."""
        return self.journal.tolerates(what, error)

    def caption(self) -> Caption:
        """Return what is written on the frame of this moment."""
        began, now = self.episode.reset_clock, self.subject.clock()
        return Caption(
            episode_id=self.episode.episode_id,
            step=self.stats.steps or 0,
            time=None if began is None or now is None else now - began,
            reward=self.stats.rewards or 0.0,
        )

    def can_be_deferred(self, start: EpisodeStart) -> bool:
        """Tell whether frames can be made from the states that begin with `start`.

        Why not is said once.

        Raises:
            PicturesDiffer, NoPictures: as `check_refusal`.
        """
        refusal = start.refusal
        if refusal is None:
            return True
        check_refusal(self.subject, refusal)
        if refusal not in self._said:
            self._said.add(refusal)
            logger.warning(
                "The videos of %s are drawn live: %s.", self.subject.env_id, refusal
            )
        return False

    def promise(
        self, path: Path, recording: str, *, second_name: Mapping[str, str]
    ) -> dict[str, Any]:
        """Return what a trajectory, or a clip, says of its video.

        Args:
            path: where it will be, without the ending.
            recording: when it is drawn, `DEFERRED` or `LIVE`.
            second_name: as of `second_name`.
        """
        options, subject = self.options, self.subject
        promise: dict[str, Any] = {
            "name": f"{path.name}.mp4",
            "quality": options.quality,
            "fps": None if options.fps is None else str(options.fps),
            "max_fps": None if options.max_fps is None else str(options.max_fps),
            "recording": recording,
            "reason": subject.rendering.reason if recording == LIVE else None,
        }
        if subject.cameras:
            promise["cameras"] = list(subject.cameras)
            promise["tiled"] = options.tiled
        if options.annotate:
            promise["annotate"] = True
        if self.selection:
            promise["selection"] = self.selection
        return {**promise, **second_name}

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
            "episode_id": episode.episode_id,
            "infix": str(self.infix),
            "env_id": self.subject.env_id,
            "type": episode.type,
            "start_time": episode.start_time,
            "seed": episode.seed,
            "options": episode.options,
            "environment": self.subject.environment,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
            "model": None if start is None else start.model,
            "scene": None if start is None else start.scene,
            "refusal": None if start is None else start.refusal,
        }

    def live_facts(self) -> dict[str, Any]:
        """Return what the metadata of a live video says of the running episode."""
        reason = self.subject.rendering.reason
        episode = self.episode
        return {
            "episode_id": episode.episode_id,
            **({} if reason is None else {"recording_reason": reason}),
            "type": episode.type,
            "env_id": self.subject.env_id,
            "seed": episode.seed,
            "options": episode.options,
            "recording": LIVE,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
            **({"selection": self.selection} if self.selection else {}),
        }

    def live_videos(
        self,
        path: Path,
        *,
        second_name: Mapping[str, str],
        on_picture_error: Callable[[Exception], object] = lambda _: None,
    ) -> LiveVideos:
        """Return what draws videos while the simulation runs, of each camera.

        Args:
            path: of the first camera's, without its ending.
            second_name: as of `second_name`.
            on_picture_error: as of `LiveVideos`.
        """
        recorders = [self._live_recorder(path, self.subject.pictures)]
        if recorders[0].path is not None:
            recorders[0].metadata.update(second_name)
            for name, pictures in self.subject.further_pictures.items():
                other_path = path.with_name(f"{path.name}.{name}")
                other = self._live_recorder(other_path, pictures)
                other.metadata["first_video"] = Path(recorders[0].path).name
                for second in second_name.values():
                    other.metadata["also_named"] = second_name_of(
                        Path(str(other.path)).name,
                        second,
                        first=Path(recorders[0].path).name,
                    )
                recorders.append(other)
        return LiveVideos(
            recorders,
            tolerates=functools.partial(self.tolerates, "video"),
            on_picture_error=on_picture_error,
        )

    def no_video(self) -> VideoRecorder:
        """Return what stands for the video of an episode that gets none."""
        return self._no_video

    def _live_recorder(
        self, base_path: Path, pictures: EpisodePictures
    ) -> VideoRecorder:
        options = self.options
        return VideoRecorder(
            pictures,
            base_path=base_path,
            metadata=self.live_facts(),
            fps=options.fps,
            max_fps=options.max_fps,
            frame_hashes=True,
            clock=self.subject.clock,
            declared=self.subject.declared,
            facts=pictures.facts,
            strict=options.strict,
            caption=self.caption if options.annotate else None,
        )

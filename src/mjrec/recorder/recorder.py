# SPDX-License-Identifier: Apache-2.0
"""The recorder: told reset, step and close, it fills a monitor directory."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

from ..errors import Error, InvalidArgument, NoPictures
from ..formats.journal import JournalEntry, JournalWriter
from ..formats.manifest import Manifest, write_manifest
from ..formats.monitor_directory import (
    journal_name,
    manifest_name,
    stats_prefix,
    video_prefix,
)
from ..rates import to_rate
from ..schedules import disable_videos, schedule_name, to_schedule
from .opening import OpenDirectory, open_directory
from .stats_recorder import StatsRecorder
from .video_recorder import PictureSource, VideoRecorder, can_give_pictures

__all__ = ["EpisodePictures", "Recorder", "RecorderOptions"]

logger = logging.getLogger(__name__)

_FORMAT_VERSION = 1
_GYM_VERSION = "mjrec-1"
_MODES = {None: "t", "training": "t", "evaluation": "e"}
_PACKAGES = ("mjrec", "mujoco", "gymnasium", "dm-control", "numpy", "imageio-ffmpeg")


class EpisodePictures(PictureSource, Protocol):
    """Where the pictures of a run come from, episode by episode."""

    def begin_episode(self) -> None:
        """Prepare for pictures of an episode; the environment has just been reset."""

    def facts(self) -> Mapping[str, Any]:
        """Return what the metadata of a video says about its pictures."""

    def close(self) -> None:
        """Free what was acquired; idempotent."""


@dataclass(frozen=True, kw_only=True)
class RecorderOptions:
    """What a monitor was asked for; `mjrec.Monitor` says what each means."""

    video_callable: Callable[[int], Any] | bool | None = None
    force: bool = False
    resume: bool = False
    write_upon_reset: bool = False
    uid: str | None = None
    mode: str | None = None
    fps: float | Fraction | None = None
    allow_early_reset: bool = False


@dataclass
class _Videos:
    """What became of the videos so far, for the manifest."""

    scheduled: list[int] = field(default_factory=list)
    finished: list[tuple[str, str]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


class Recorder:
    """Drives statistics, journal, video and manifest of one monitor.

    It is told what happens to an environment and never calls it, except for pictures:
    `before_reset`, the environment's reset, `reset`; `before_step`, the environment's
    step, `step`; `close`. It belongs to the process that made it.

    Args:
        directory: the monitor directory.
        env_id: the environment's name.
        pictures: where the pictures come from.
        options: what was asked for.
        clock: returns the simulated time in seconds, or None.
        declared: returns the rate to take where there is no simulated time.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        env_id: str,
        pictures: EpisodePictures,
        options: RecorderOptions,
        clock: Callable[[], float | None] | None = None,
        declared: Callable[[], Fraction] | None = None,
    ) -> None:
        self._schedule = to_schedule(options.video_callable)
        episode_type = _type_of_mode(options.mode)
        if options.fps is not None:
            to_rate(options.fps)
        if self._schedule is not disable_videos:
            _check_pictures(pictures, env_id)
        self._env_info = {"gym_version": _GYM_VERSION, "env_id": env_id}
        self._pictures = pictures
        self._options = options
        self._clock = clock
        self._declared = declared
        self._pid = os.getpid()
        self._videos = _Videos()
        self._decision = (-1, False)
        self._place: OpenDirectory = open_directory(
            directory,
            force=options.force,
            resume=options.resume,
            uid=options.uid,
            env_info=self._env_info,
        )
        self._next_episode_id = self._place.first_episode_id
        self._episode_start: dict[str, Any] = {}
        self._journal = JournalWriter(self.directory / journal_name(self._place.infix))
        self.stats_recorder = StatsRecorder(
            str(self.directory),
            stats_prefix(self._place.infix),
            env_id=env_id,
            allow_early_reset=options.allow_early_reset,
        )
        self.stats_recorder.type = episode_type
        self.video_recorder: VideoRecorder | None = None
        self.closed = False

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
        self.stats_recorder.type = _type_of_mode(mode)

    def before_reset(self) -> None:
        """Check that a reset may be made now.

        Raises:
            ResetNotAllowed: in mid-episode, unless early resets are allowed.
            Error: in a process forked from the one that made the recorder.
        """
        self._check_process()
        self.stats_recorder.before_reset()
        self._reset_time = time.time()

    def reset(self, *, seed: Any = None, options: Any = None) -> None:
        """Begin an episode; the environment has just been reset.

        A reset before any step of the running episode keeps its number and replaces
        its picture. One in mid-episode ends that episode's video, marked incomplete.

        Args:
            seed: the seed given to the environment's reset.
            options: the options given to it.
        """
        if self.stats_recorder.done is False and self.stats_recorder.steps == 0:
            self._next_episode_id -= 1
            if self.video_recorder is not None:
                self.video_recorder.discard()
        else:
            self._end_video(complete=False, reason="reset")
        self.stats_recorder.after_reset()
        self._episode_start = {
            "start_time": self._reset_time,
            "seed": seed,
            "options": options,
        }
        episode_id = self._next_episode_id
        self._next_episode_id += 1
        self._begin_video(episode_id)
        if self._options.write_upon_reset:
            self._flush()

    def before_step(self) -> None:
        """Check that a step may be taken now.

        Raises:
            ResetNeeded: before the first reset, or after the end of an episode.
            Error: in a process forked from the one that made the recorder.
        """
        self._check_process()
        self.stats_recorder.before_step()

    def step(
        self,
        reward: Any,
        *,
        terminated: bool,
        truncated: bool,
        picture: bool = True,
    ) -> None:
        """Record a step that the environment has just taken.

        Args:
            reward: a number or an array of one element.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            picture: False where the environment has reset itself already, and its
                picture belongs to the next episode.
        """
        done = self.stats_recorder.after_step(None, reward, terminated or truncated)
        ending = {"terminated": bool(terminated), "truncated": bool(truncated)}
        if done:
            # First of all, so that no failing video can lose the episode.
            self._journal_episode(**ending)
        try:
            self._take_picture(missing=not picture)
        finally:
            if done:
                self._end_video(complete=True, **ending)

    def close(self) -> None:
        """Finish the video, write statistics and manifest, and let go. Idempotent.

        An episode that is not over is no part of the statistics; its video is kept,
        marked incomplete. Where it is interrupted (Ctrl-C), the next call goes on.

        Raises:
            EncoderError: the video could not be finished; the rest is written.
            FileNotWritten: the disk is full; the next call tries again.
        """
        if self.closed:
            return
        try:
            self._end_video(complete=False, reason="close")
        except Exception:
            self._let_go()
            raise
        self._let_go()
        logger.info("Finished writing results. They are in %s.", self.directory)

    def _let_go(self) -> None:
        # Where it fails, all stays open, and the next close tries again.
        self._flush()
        self.closed = True
        self.stats_recorder.closed = True
        self._journal.close()
        self._place.lock.release()

    def _check_process(self) -> None:
        if os.getpid() != self._pid:
            raise Error(
                f"This monitor belongs to process {self._pid}, and this is "
                f"{os.getpid()}, forked from it. Two processes cannot write the same "
                "files: make the monitor inside the process that uses it."
            )

    def _take_picture(self, *, missing: bool) -> None:
        recorder = self.video_recorder
        if recorder is None or not recorder.functional:
            return
        if missing:
            recorder.metadata["final_frame"] = "missing"
        else:
            recorder.capture_frame()

    def _begin_video(self, episode_id: int) -> None:
        self.video_recorder = VideoRecorder(
            self._pictures,
            base_path=self.directory / video_prefix(self._place.infix, episode_id),
            metadata={"episode_id": episode_id},
            enabled=self._decide(episode_id),
            fps=self._options.fps,
            frame_hashes=True,
            clock=self._clock,
            declared=self._declared,
            facts=self._pictures.facts,
        )
        if self.video_recorder.enabled:
            self._pictures.begin_episode()
        self.video_recorder.capture_frame()

    def _decide(self, episode_id: int) -> bool:
        """Ask the schedule; only once for a number, which resets may share."""
        if self._decision[0] != episode_id:
            self._decision = (episode_id, bool(self._schedule(episode_id)))
            if self._decision[1]:
                self._videos.scheduled.append(episode_id)
        return self._decision[1]

    def _journal_episode(self, *, terminated: bool, truncated: bool) -> None:
        stats = self.stats_recorder
        self._journal.append(
            JournalEntry(
                episode_id=self._next_episode_id - 1,
                length=stats.episode_lengths[-1],
                reward=stats.episode_rewards[-1],
                type=stats.episode_types[-1],
                end_time=stats.timestamps[-1],
                terminated=terminated,
                truncated=truncated,
                **self._episode_start,
            )
        )

    def _end_video(self, *, complete: bool, **facts: Any) -> None:
        """Finish the running video, if there is one; what is known goes with it."""
        recorder = self.video_recorder
        if recorder is None or not recorder.enabled or recorder.closed:
            return
        stats = self.stats_recorder
        if "complete" not in recorder.metadata:
            # Else an end that was interrupted is taken up again.
            recorder.metadata.update(complete=complete, **facts)
        recorder.metadata.update(
            length=stats.steps,
            reward=stats.rewards,
            type=stats.episode_type,
            env_id=self._env_info["env_id"],
            seed=self._episode_start.get("seed"),
            options=self._episode_start.get("options"),
            recording="live",
            versions=_versions(),
        )
        try:
            recorder.close()
        finally:
            if recorder.closed:
                self._note(recorder)

    def _note(self, recorder: VideoRecorder) -> None:
        assert recorder.path is not None
        assert recorder.metadata_path is not None
        names = (Path(recorder.path).name, Path(recorder.metadata_path).name)
        if recorder.broken:
            self._videos.broken.append(names[1])
        elif recorder.finished:
            self._videos.finished.append(names)

    def _flush(self) -> None:
        self.stats_recorder.flush()
        write_manifest(
            self.directory / manifest_name(self._place.infix),
            Manifest(
                stats=Path(self.stats_recorder.path).name,
                videos=tuple(self._videos.finished),
                env_info=self._env_info,
                mjrec=self._details(),
            ),
        )

    def _details(self) -> dict[str, Any]:
        """Return what gym's manifests do not say."""
        return {
            "format_version": _FORMAT_VERSION,
            "schedule": {
                "name": schedule_name(self._schedule),
                # It decided about every number from first to next; these got a yes.
                "recorded": self._videos.scheduled,
            },
            "first_episode_id": self._place.first_episode_id,
            "next_episode_id": self._next_episode_id,
            "pending": [],
            "broken": self._videos.broken,
            "versions": _versions(),
        }


def _type_of_mode(mode: str | None) -> str:
    if mode not in _MODES:
        raise InvalidArgument(
            f'mode must be "training", "evaluation" or None, got {mode!r}.'
        )
    return _MODES[mode]


def _check_pictures(pictures: PictureSource, env_id: str) -> None:
    if can_give_pictures(pictures):
        return
    raise NoPictures(
        f"Videos were asked for, and {env_id} gives no pictures: "
        f"{_what_is_missing(pictures)}, or record statistics only with "
        "video_callable=False."
    )


def _what_is_missing(pictures: PictureSource) -> str:
    mode = getattr(pictures, "render_mode", None)
    return getattr(
        pictures,
        "missing",
        f"its render_mode is {mode!r}. Make the environment with "
        'render_mode="rgb_array"',
    )


def _versions() -> dict[str, str]:
    """Return the versions of what made the recording."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions

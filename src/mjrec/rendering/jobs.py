# SPDX-License-Identifier: Apache-2.0
"""Render jobs and their results, as plain data.

A job is about one recording. It is the same wherever it is done: in this process, in
the background process of a simulation, or in an engine's worker. It can safely be done
twice, even by two processes at once: the second finds nothing left to do, or replaces
the file with an identical one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from ..formats.monitor_directory import (
    VideoName,
    clip_lock_name,
    clip_part_name,
    clip_step,
    episode_of,
    infix_of,
    trajectory_prefix,
    video_lock_name,
    video_prefix,
)
from ..formats.notebook import shown
from .views import Variant


@dataclass(frozen=True, kw_only=True)
class Progress:
    """The progress of rendering.

    Attributes:
        videos_done: number of videos that are finished or have failed.
        videos: number of videos known so far.
        frames_done: number of frames of these videos that are drawn.
        frames: number of frames of these videos. None if an engine draws them: the
            frames of a video are then counted only when it is finished.
    """

    videos_done: int = 0
    videos: int = 0
    frames_done: int = 0
    frames: int | None = 0


@dataclass(frozen=True)
class RecordingKey:
    """The key of a recording within its directory.

    Attributes:
        infix: the infix of its monitor.
        number: the episode's number; for a clip, the number of steps that the monitor
            had recorded when it began.
        is_clip: whether it is a clip.
    """

    infix: str
    number: int
    is_clip: bool = False

    @property
    def name(self) -> str:
        """The base name of the trajectory, without extension, or of the first part."""
        if self.is_clip:
            return clip_part_name(self.infix, self.number, 0)
        return trajectory_prefix(self.infix, self.number)

    @property
    def video_name(self) -> str:
        """The base name of an episode's video.

        The name of a clip's video cannot be derived from the key: only its rows record
        the episode in which the clip began.
        """
        return f"{video_prefix(self.infix, self.number)}.mp4"

    @property
    def shown_name(self) -> str:
        """The name to show for it when only the key is known."""
        return self.name if self.is_clip else self.video_name

    @property
    def lock_name(self) -> str:
        """The name of the file that the process working on it locks."""
        name_of = clip_lock_name if self.is_clip else video_lock_name
        return name_of(self.infix, self.number)


def key_of(name: str) -> RecordingKey | None:
    """Return the key of the recording that a file belongs to; None for other files.

    The video of a clip that began with an episode has the name of that episode's video.
    """
    infix, step, video = infix_of(name), clip_step(name), VideoName.parse(name)
    if video is not None:
        step = video.first_step
    number = episode_of(name) if step is None else step
    if infix is None or number is None:
        return None
    return RecordingKey(infix, number, is_clip=step is not None)


@dataclass(frozen=True, kw_only=True)
class VideoJob:
    """One recording to render.

    Attributes:
        directory: the monitor directory.
        recording: the name of one of its files; with a variant, of its trajectory.
        strict: whether a blank video is a failure.
        variant: the changes for a video next to the original. None finishes what is
            pending.
        video: the path of that video. None without a variant.
    """

    directory: Path
    recording: str
    strict: bool = False
    variant: Variant | None = None
    video: Path | None = None

    @classmethod
    def finishing(
        cls, directory: Path, key: RecordingKey, *, strict: bool = False
    ) -> Self:
        """Return the job that finishes the pending parts of a recording."""
        return cls(directory=directory, recording=key.shown_name, strict=strict)

    @property
    def name(self) -> str:
        """A unique name: the path of the video to write, or of the recording."""
        return str(self.video or self.directory / self.recording)

    @property
    def shown_name(self) -> str:
        """The name to show for it before it is known which videos it writes."""
        return self.key.shown_name if self.video is None else self.video.name

    @property
    def video_directory(self) -> Path:
        """The directory of the videos that it writes."""
        return self.directory if self.video is None else self.video.parent

    @property
    def key(self) -> RecordingKey:
        """The key of the recording that it finishes."""
        key = key_of(self.recording)
        assert key is not None
        return key


@dataclass(frozen=True, kw_only=True)
class RenderedVideos:
    """The results of rendering, by file name.

    Attributes:
        directory: the directory of the videos.
        videos: number of frames of each rendered video.
        trajectories: finished trajectories of episodes without a video.
        failures: the reason for each video that could not be rendered.
        blank: with `strict`, what is wrong with each blank video.
        elsewhere: videos that another process is rendering.
    """

    directory: Path
    videos: Mapping[str, int] = field(default_factory=dict)
    trajectories: Sequence[str] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    blank: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Sequence[str] = ()

    @classmethod
    def joined(cls, parts: Iterable[Self], directory: Path) -> Self:
        """Combine several results, in which each name occurs only once.

        Args:
            parts: the results.
            directory: the directory of the videos, if there are no results.
        """
        parts = list(parts)
        return cls(
            directory=parts[-1].directory if parts else directory,
            videos={name: n for part in parts for name, n in part.videos.items()},
            trajectories=tuple(name for part in parts for name in part.trajectories),
            failures={name: w for part in parts for name, w in part.failures.items()},
            blank={name: why for part in parts for name, why in part.blank.items()},
            elsewhere=tuple(name for part in parts for name in part.elsewhere),
        )

    def _repr_html_(self) -> str:
        """Show the videos in a notebook, and why others are missing."""
        facts = {"frames": sum(self.videos.values()), **self.failures, **self.blank}
        title = f"{len(self.videos)} rendered, {len(self.failures)} failed"
        return shown(title, facts, [self.directory / name for name in self.videos])

    @property
    def is_empty(self) -> bool:
        """Whether there was nothing to do."""
        return not (self.videos or self.trajectories or self.failures or self.elsewhere)

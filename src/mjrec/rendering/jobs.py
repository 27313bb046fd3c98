# SPDX-License-Identifier: Apache-2.0
"""What is to be rendered and its results, in plain data.

A job is about one recording, and the same wherever it is done: in this process, in the
one beside a simulation, by a worker of an engine. It can be done twice, also by two at
once: the second finds nothing left to do, or puts the same file in its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    VideoName,
    clip_lock_name,
    clip_part_name,
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
    """How far a rendering is.

    Attributes:
        videos_done: how many videos are over, also as failures.
        videos: how many there are, as far as is known.
        frames_done: how many frames of these videos are drawn.
        frames: how many frames these videos have; None where they were not counted:
            the frames of a video that an engine's worker draws are known when it is
            over.
    """

    videos_done: int = 0
    videos: int = 0
    frames_done: int = 0
    frames: int | None = 0


@dataclass(frozen=True)
class RecordingKey:
    """Which recording of a directory.

    Attributes:
        infix: of its monitor.
        number: the episode's; of a clip, how many steps the monitor had recorded when
            it began.
        is_clip: whether it is a clip.
    """

    infix: Infix
    number: int
    is_clip: bool = False

    @property
    def name(self) -> str:
        """The base name of the trajectory without extension; that of the first part."""
        if self.is_clip:
            return clip_part_name(self.infix, self.number, 0)
        return trajectory_prefix(self.infix, self.number)

    @property
    def video_name(self) -> str:
        """The base name of an episode's video. In which a clip began, only rows say."""
        return f"{video_prefix(self.infix, self.number)}.mp4"

    @property
    def shown_name(self) -> str:
        """What it is called where nothing is known of it."""
        return self.name if self.is_clip else self.video_name

    @property
    def lock_name(self) -> str:
        """The name of the file that is locked by the process that works on it."""
        name_of = clip_lock_name if self.is_clip else video_lock_name
        return name_of(self.infix, self.number)


def key_of(name: str) -> RecordingKey | None:
    """Return that of the recording that a file is of; None for other files.

    A clip's video that began with an episode is called as that episode's.
    """
    if (part := ClipPart.parse(name)) is not None:
        return RecordingKey(part.infix, part.first_step, is_clip=True)
    infix, number = Infix.parse(infix_of(name) or ""), episode_of(name)
    if infix is None or number is None:
        return None
    video = VideoName.parse(name)
    if video is not None and video.first_step is not None:
        return RecordingKey(infix, video.first_step, is_clip=True)
    return RecordingKey(infix, number)


@dataclass(frozen=True, kw_only=True)
class VideoJob:
    """One recording that is to be rendered.

    Attributes:
        directory: where it is.
        recording: the name of one of its files; with a variant, of its trajectory.
        strict: whether a video that shows nothing is a failure.
        variant: what is to be other, for a video beside the original; None finishes
            what is pending.
        video: the video with a variant.
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
        """Return the job that finishes what is pending of a recording."""
        return cls(directory=directory, recording=key.shown_name, strict=strict)

    @property
    def name(self) -> str:
        """What tells it from other jobs: the path of what it makes, as far as known."""
        return str(self.video or self.directory / self.recording)

    @property
    def key(self) -> RecordingKey:
        """Which recording it finishes."""
        key = key_of(self.recording)
        assert key is not None
        return key


@dataclass(frozen=True, kw_only=True)
class RenderedVideos:
    """The results of a rendering, by file name.

    Attributes:
        directory: where the videos are.
        videos: number of frames of each rendered video.
        trajectories: finished trajectories of episodes without a video.
        failures: reasons of videos that could not be rendered.
        blank: with `strict`: what is wrong with videos that show nothing.
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
        """Return what several results, in which no name comes twice, come to.

        Args:
            parts: the results.
            directory: where the videos are, if there are no results that say it.
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

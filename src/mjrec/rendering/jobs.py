# SPDX-License-Identifier: Apache-2.0
"""Render jobs, their settings and their results, as plain data.

A job is for one recording. It is the same wherever it runs: in this process, in the
background process of a simulation, or in an engine's worker. It can safely run twice,
even in two processes at the same time: the second one finds nothing left to do, or
replaces the file with an identical one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np

from ..errors import InvalidArgument, UnknownName
from ..formats.monitor_directory import (
    VideoName,
    clip_part_name,
    clip_prefix,
    clip_step,
    episode_of,
    infix_of,
    trajectory_prefix,
    video_prefix,
)
from ..formats.notebook import shown
from ..frames import check_quality, check_size
from ..rates import to_rate

PlainCamera: TypeAlias = str | int | dict[str, Any]

# The public members of a `mujoco.MjvCamera`.
CAMERA_MEMBERS = (
    *("type", "fixedcamid", "trackbodyid", "lookat", "distance"),
    *("azimuth", "elevation", "orthographic"),
)


@dataclass(frozen=True, kw_only=True)
class View:
    """The camera, size and quality of frames; None means as recorded.

    Attributes:
        camera: the name or number of one of the model's cameras, -1 for the free camera
            where the model places it, or the members of a `mujoco.MjvCamera`, keyed by
            name (omitted members have MuJoCo's defaults). Any value that `plain_camera`
            accepts may be passed.
        height: height in pixels.
        width: width in pixels.
        quality: `"full"` or `"draft"`.

    Raises:
        UnknownName: the quality, or a member of the `MjvCamera`, does not exist.
        InvalidArgument: the size or the camera is invalid. It is not checked here
            whether the model has the camera.
    """

    camera: PlainCamera | None = None
    height: int | None = None
    width: int | None = None
    quality: str | None = None

    def __post_init__(self) -> None:
        check_size(
            1 if self.height is None else self.height,
            1 if self.width is None else self.width,
        )
        if self.quality is not None:
            check_quality(self.quality)
        # Convert NumPy integers and an `MjvCamera` to plain values.
        plain: Mapping[str, Callable[[Any], object]]
        plain = {"camera": plain_camera, "height": int, "width": int}
        for name, make in plain.items():
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, make(value))


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Changes for rerendering a recording; None means as recorded.

    Attributes:
        view: the camera, size and quality.
        max_fps: maximum frames per second of simulated time. Recorded frames 0, n, 2n
            ... with the smallest n that fits are drawn, and also the last frame.
        fps: frames per second of the file. If None, the video plays at its recorded
            speed.
        annotate: whether the episode, step, time and return are written on the frames.

    Raises:
        InvalidArgument: `max_fps` or `fps` is not a valid rate.
    """

    view: View = field(default_factory=View)
    max_fps: float | Fraction | None = None
    fps: float | Fraction | None = None
    annotate: bool | None = None

    def __post_init__(self) -> None:
        for rate in (self.max_fps, self.fps):
            if rate is not None:
                to_rate(rate)


def plain_camera(camera: Any) -> PlainCamera:
    """Return a camera in a JSON-serializable form.

    Args:
        camera: a name, a number, a `mujoco.MjvCamera`, or a mapping of its members.

    Raises:
        UnknownName: a key of the mapping is not a member of `MjvCamera`.
        InvalidArgument: `camera` has a different type, or a member's value is invalid.
    """
    if isinstance(camera, str):
        return camera
    if isinstance(camera, int | np.integer) and not isinstance(camera, bool):
        return int(camera)
    if isinstance(camera, Mapping):
        return {name: _plain_member(name, camera[name]) for name in camera}
    # Compare the type's name, so that mujoco need not be imported here.
    if type(camera).__name__ == "MjvCamera":
        return {n: _plain_member(n, getattr(camera, n)) for n in CAMERA_MEMBERS}
    raise InvalidArgument(
        "A camera must be a name, a number, a mujoco.MjvCamera or a mapping of its "
        f"members, got {camera!r} of type {type(camera).__name__}."
    )


def _plain_member(name: str, value: Any) -> Any:
    if name not in CAMERA_MEMBERS:
        raise UnknownName("mujoco.MjvCamera member", name, CAMERA_MEMBERS)
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    expected = (3,) if name == "lookat" else ()
    if numbers.shape != expected or not np.isfinite(numbers).all():
        what = "three numbers" if expected else "a number"
        raise InvalidArgument(f"A camera's {name} must be {what}, got {value!r}.")
    if name in ("lookat", "distance", "azimuth", "elevation"):
        return numbers.tolist()
    return int(numbers)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """The progress of rendering.

    Attributes:
        videos_done: number of videos that are finished or have failed.
        videos: number of videos known so far.
        frames_done: number of frames of these videos that have been drawn.
        frames: number of frames of these videos. None if an engine draws them, because
            a video's frames are then counted only when the video is finished.
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
        number: the episode's number. For a clip, the number of steps that the monitor
            had recorded when the clip began.
        is_clip: whether the recording is a clip.
    """

    infix: str
    number: int
    is_clip: bool = False

    @property
    def name(self) -> str:
        """The base name, without extension, of the trajectory or of the first part."""
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
        """The name to show for the recording when only its key is known."""
        return self.name if self.is_clip else self.video_name

    @property
    def lock_name(self) -> str:
        """The name of the lock file for the process that works on the recording."""
        prefix_of = clip_prefix if self.is_clip else video_prefix
        return f".{prefix_of(self.infix, self.number)}.lock"


def key_of(name: str) -> RecordingKey | None:
    """Return the key of the recording that a file belongs to; None for other files.

    The video of a clip that began with an episode is named like that episode's video.
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
        recording: the name of any of its files; with a variant, of its trajectory.
        strict: whether a blank video is a failure.
        variant: the changes for a video next to the original. With None, the job
            finishes the pending videos.
        video: the path of that video; None without a variant.
    """

    directory: Path
    recording: str
    strict: bool = False
    variant: Variant | None = None
    video: Path | None = None

    @property
    def name(self) -> str:
        """A unique name: the path of the video to write, or of the recording."""
        return str(self.video or self.directory / self.recording)

    @property
    def shown_name(self) -> str:
        """The name to show for the job before its videos are known."""
        return self.key.shown_name if self.video is None else self.video.name

    @property
    def video_directory(self) -> Path:
        """The directory that the job writes its videos to."""
        return self.directory if self.video is None else self.video.parent

    @property
    def key(self) -> RecordingKey:
        """The key of the recording that the job finishes."""
        key = key_of(self.recording)
        assert key is not None
        return key


@dataclass(frozen=True, kw_only=True)
class RenderedVideos:
    """The results of rendering, keyed by file name.

    Attributes:
        directory: the directory of the videos. If they lie in several, the one that
            contains them all, and the names are relative paths.
        videos: number of frames of each rendered video.
        trajectories: the finished trajectories of episodes without a video.
        failures: the reason for each video that could not be rendered.
        blank: with `strict`, the reason why each video counts as blank.
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
        """Combine several results. No path may occur in more than one of them.

        Args:
            parts: the results.
            directory: the directory of the videos, if there are no results.
        """
        parts = list(parts)
        if parts:
            directory = Path(os.path.commonpath([part.directory for part in parts]))
        placed = [(part.directory.relative_to(directory), part) for part in parts]
        return cls(
            directory=directory,
            videos={
                str(at / x): n for at, part in placed for x, n in part.videos.items()
            },
            trajectories=tuple(
                str(at / x) for at, part in placed for x in part.trajectories
            ),
            failures={
                str(at / x): w for at, part in placed for x, w in part.failures.items()
            },
            blank={
                str(at / x): w for at, part in placed for x, w in part.blank.items()
            },
            elsewhere=tuple(str(at / x) for at, part in placed for x in part.elsewhere),
        )

    def _repr_html_(self) -> str:
        """Show the videos in a notebook, and the reasons why others are missing."""
        facts = {"frames": sum(self.videos.values()), **self.failures, **self.blank}
        title = f"{len(self.videos)} rendered, {len(self.failures)} failed"
        return shown(title, facts, [self.directory / name for name in self.videos])

    @property
    def is_empty(self) -> bool:
        """Whether there was nothing to do."""
        return not (self.videos or self.trajectories or self.failures or self.elsewhere)

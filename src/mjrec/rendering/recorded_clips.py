# SPDX-License-Identifier: Apache-2.0
"""Videos that are counted in steps, as the logs of a directory hold them.

Such a video may go on across resets, and then is a span for each of its parts, one
behind the other. They stay in the log, and are dropped when the video is there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.in_flight import recordings_in_flight
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    clip_lock_name,
    clip_part_name,
    infix_of,
    lock_name,
)
from ..formats.trajectory import added_up
from ..formats.video_metadata import is_done
from .recorded_facts import model_file, open_for_rendering
from .recorded_pictures import ChosenFrames, chosen_frames, recorded_rate
from .videos import further_video_paths, video_path

_VIDEO = re.compile(r".*\.video[0-9]{6,18}\.step(?P<step>[0-9]{6,18})\.mp4")


@dataclass(frozen=True)
class ClipKey:
    """Which clip of a directory.

    Attributes:
        infix: of its monitor.
        first_step: how many steps the monitor had recorded when it began.
    """

    infix: Infix
    first_step: int

    @classmethod
    def of(cls, name: str) -> ClipKey | None:
        """Return that of the clip that a file is a part of; None for other files.

        Also that of a video that a step began; what began with an episode is called
        as that episode's.
        """
        part = ClipPart.parse(name)
        if part is not None:
            return cls(part.infix, part.first_step)
        video = _VIDEO.fullmatch(name)
        infix = Infix.parse(infix_of(name) or "")
        if video is None or infix is None:
            return None
        return cls(infix, int(video["step"]))

    @property
    def lock_name(self) -> str:
        """The name of what whoever is at it holds locked."""
        return clip_lock_name(self.infix, self.first_step)

    @property
    def recording_name(self) -> str:
        """What its first part is called."""
        return clip_part_name(self.infix, self.first_step, 0)

    @property
    def told_name(self) -> str:
        """What it is called where its video's name is not known."""
        return self.recording_name


@dataclass(frozen=True, kw_only=True)
class RecordedClip:
    """What the parts of a clip say, all together.

    Attributes:
        parts: what they are called, in their order.
        facts: of each.
        frame_counts: likewise.
        step_count: of all.
        reward: of all steps.
    """

    parts: tuple[Path, ...]
    facts: tuple[Mapping[str, Any], ...]
    frame_counts: tuple[int, ...]
    step_count: int
    reward: float

    @property
    def frame_count(self) -> int:
        """How many pictures were recorded."""
        return sum(self.frame_counts)

    @property
    def timing(self) -> Mapping[str, Any]:
        """The facts of the first part that has measured the time of a step."""
        known = [facts for facts in self.facts if facts.get("timestep") is not None]
        return known[0] if known else self.facts[0]

    def chosen(self) -> ChosenFrames:
        """Return which of the pictures are wanted, counted over all parts.

        All are recorded: which of them are 0, n, 2n ... does not begin anew with each
        part.
        """
        asked = (self.facts[0].get("video") or {}).get("max_fps")
        if asked is None or recorded_rate(self.timing) is None:
            return chosen_frames(self.frame_count, self.timing, None)
        return chosen_frames(self.frame_count, self.timing, Fraction(asked))


@dataclass(frozen=True, kw_only=True)
class PendingClip:
    """A clip that is left to do.

    Attributes:
        key: which one.
        parts: what its parts are called, in their order.
        video: what is to be rendered; None where nothing is.
        further_videos: what is to be rendered besides, of further cameras.
        frame_count: how many frames are to be rendered, of all of these.
        model_file: what has to be there for rendering, if it is known.
    """

    key: ClipKey
    parts: tuple[Path, ...]
    video: Path | None
    frame_count: int
    model_file: Path | None
    further_videos: tuple[Path, ...] = ()

    @property
    def video_count(self) -> int:
        """How many videos are to be rendered."""
        return int(self.video is not None) + len(self.further_videos)


def recorded_clips(directory: Path) -> list[ClipKey]:
    """Return the clips in flight, monitor by monitor, in order."""
    parts = (ClipPart.parse(each.name) for each in recordings_in_flight(directory))
    keys = {ClipKey(part.infix, part.first_step) for part in parts if part is not None}
    return sorted(
        keys,
        key=lambda key: (key.infix.monitor_id, key.infix.uid, key.first_step),
    )


def clip_parts(directory: Path, key: ClipKey) -> list[Path]:
    """Return what the parts of a clip are called, in their order."""
    # In which they are in the logs, too.
    return [
        recording.path
        for recording in recordings_in_flight(directory, key.infix)
        if (part := ClipPart.parse(recording.name)) is not None
        and part.first_step == key.first_step
    ]


def read_clip(parts: Sequence[Path]) -> RecordedClip:
    """Read what the parts of a clip say.

    Raises:
        UnreadableFile: one is missing or damaged.
    """
    facts: list[Mapping[str, Any]] = []
    frame_counts: list[int] = []
    rewards: list[float] = []
    for number, path in enumerate(parts):
        name = ClipPart.parse(path.name)
        if name is None or name.number != number:
            raise UnreadableFile(path, f"part {number} of its video is not there")
        with open_for_rendering(path) as reader:
            facts.append(reader.header.facts)
            frame_counts.append(reader.frame_count)
            rewards += reader.rewards.tolist()
    return RecordedClip(
        parts=tuple(parts),
        facts=tuple(facts),
        frame_counts=tuple(frame_counts),
        step_count=len(rewards),
        reward=added_up(rewards),
    )


def look_at_clip(directory: Path, key: ClipKey) -> PendingClip | None:
    """Return what is left to do about a clip; None where it is nothing.

    One that is still running is nobody's business but its monitor's: its last log does
    not say how it ended, and somebody holds the monitor's lock. Of a dead monitor the
    logs that are there are all of it.

    Raises:
        UnreadableFile: a log is missing or damaged, or of a newer format, or says what
            cannot be.
        OSError: its monitor's lock cannot be looked at.
    """
    # Asked first: a log that comes later is of a monitor that is open.
    is_open = is_locked(directory / lock_name(key.infix))
    parts = clip_parts(directory, key)
    if not parts:
        return None
    if is_open and not _is_over(parts[-1]):
        return None
    with open_for_rendering(parts[0]) as reader:
        facts = reader.header.facts
    video = video_path(parts[0], facts)
    if is_done(video):
        return PendingClip(
            key=key, parts=tuple(parts), video=None, frame_count=0, model_file=None
        )
    clip = read_clip(parts)
    further = tuple(further_video_paths(parts[0], facts))
    frames = len(clip.chosen().indices)
    return PendingClip(
        key=key,
        parts=clip.parts,
        video=video,
        further_videos=further,
        frame_count=frames * (1 + len(further)),
        model_file=model_file(directory, clip.facts[-1]),
    )


def _is_over(part: Path) -> bool:
    with open_for_rendering(part) as reader:
        return "complete" in reader.header.facts

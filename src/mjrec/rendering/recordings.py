# SPDX-License-Identifier: Apache-2.0
"""The recordings in a directory, and the work left to do on each.

A recording is an episode, or a clip (a video counted in steps). Its rows are divided
into parts: an episode has one, and a clip that continues across resets has one for each
episode. An episode's part may become a file and be kept. A clip's parts are dropped
when its video is finished.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..formats.bundle import FINISHED, finished_trajectories, is_finished
from ..formats.frame_hashes import frame_hash_path
from ..formats.locks import Lock, is_locked, try_lock
from ..formats.monitor_directory import (
    clip_step,
    infix_order,
    lock_name,
    unfinished_files,
)
from ..formats.spans import find_recording, find_trajectory, recordings_in_flight
from ..formats.trajectory import added_up
from ..formats.video_metadata import is_done, metadata_path
from .jobs import RecordingKey, key_of
from .recorded_facts import (
    ChosenFrames,
    chosen_frames,
    further_video_paths,
    model_file,
    open_for_rendering,
    recorded_rate,
    video_facts,
    video_path,
)

# Used for an episode that ended before its second step; any rate would do.
_RATE_OF_ONE_FRAME = Fraction(30)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The work left to do on a recording.

    Attributes:
        parts: the paths of its parts, in order. Parts still in a log have no file.
        videos: the videos to render, the first camera's first.
        frame_count: total number of frames to render in all videos.
        logs: the logs that still contain rows of the recording.
        is_kept: whether the trajectory stays after the video is finished.
        model_file: the model file that rendering needs, if known.
    """

    parts: tuple[Path, ...]
    videos: tuple[Path, ...]
    frame_count: int
    logs: frozenset[Path] = frozenset()
    is_kept: bool = True
    model_file: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The facts about a recording, from all of its parts.

    Attributes:
        parts: the files, in order.
        facts: the facts about each part.
        frame_counts: the number of frames in each part.
        frame_steps: the step of each frame. For a clip, the number of the frame,
            because resets have frames but are not steps.
        step_count: number of steps in all parts.
        reward: the sum of the rewards over all steps.
    """

    parts: tuple[Path, ...]
    facts: tuple[Mapping[str, Any], ...]
    frame_counts: tuple[int, ...]
    frame_steps: NDArray[np.int64]
    step_count: int
    reward: float

    @property
    def is_clip(self) -> bool:
        """Whether the recording is a clip."""
        return clip_step(self.parts[0].name) is not None

    @property
    def timing(self) -> Mapping[str, Any]:
        """The facts about the first part that records how long a step takes."""
        known = (facts for facts in self.facts if facts.get("timestep") is not None)
        return next(known, self.facts[0])

    def chosen(self, max_fps: float | Fraction | None = None) -> ChosenFrames:
        """Return the frames to render, numbered across all parts.

        An episode contains only the frames that its video needs. A clip contains all
        frames, and the selection 0, n, 2n ... does not restart with each part.
        """
        if self.is_clip and recorded_rate(self.timing) is not None:
            max_fps = max_fps or video_facts(self.facts[0]).get("max_fps")
        max_fps = Fraction(max_fps) if isinstance(max_fps, str) else max_fps
        return chosen_frames(sum(self.frame_counts), self.timing, max_fps)

    def usual_fps(self, chosen: ChosenFrames) -> Fraction:
        """Return the frame rate for playing the video at its recorded speed."""
        asked = video_facts(self.facts[0]).get("fps")
        if asked is None:
            rate = recorded_rate(self.timing) or _RATE_OF_ONE_FRAME
            return rate / chosen.every
        # A clip records all frames, so `max_fps` does not affect the requested rate.
        return Fraction(asked) / (1 if self.is_clip else chosen.every)


def read_recording(parts: Sequence[Path]) -> Recorded:
    """Read the facts about a recording's parts.

    Raises:
        UnreadableFile: a part is missing or damaged.
    """
    facts: list[Mapping[str, Any]] = []
    frame_counts: list[int] = []
    rewards: list[NDArray[np.float64]] = []
    for number, path in enumerate(parts):
        is_part = clip_step(path.name) is not None
        if is_part and not path.name.endswith(f".part{number:06d}"):
            raise UnreadableFile(path, f"part {number} of its video is missing")
        with open_for_rendering(path) as reader:
            facts.append(reader.facts)
            frame_counts.append(reader.frame_count)
            rewards.append(reader.rewards)
            steps = reader.frame_steps
    if is_part:
        steps = np.arange(sum(frame_counts))
    all_rewards = np.concatenate(rewards)
    return Recorded(
        parts=tuple(parts),
        facts=tuple(facts),
        frame_counts=tuple(frame_counts),
        frame_steps=steps,
        step_count=len(all_rewards),
        reward=added_up(all_rewards),
    )


def recordings(directory: Path) -> list[RecordingKey]:
    """Return the episodes with a trajectory, then the clips in flight, in order."""
    finished = finished_trajectories(directory)
    in_flight = (recording.path for recording in recordings_in_flight(directory))
    keys = {key for path in (*finished, *in_flight) if (key := key_of(path.name))}
    return sorted(keys, key=lambda k: (k.is_clip, infix_order(k.infix), k.number))


def parts_of(directory: Path, key: RecordingKey) -> list[Path]:
    """Return the paths of a recording's parts, in order; see `Plan.parts`."""
    if not key.is_clip:
        path = find_trajectory(directory, key.infix, key.number)
        return [] if path is None else [path]
    # The logs are in the same order.
    in_flight = (each.path for each in recordings_in_flight(directory, key.infix))
    return [path for path in in_flight if key_of(path.name) == key]


def may_be_left(directory: Path, key: RecordingKey) -> bool:
    """Return whether a recording may need work, without opening a file.

    If this is false, `look_at` returns None.
    """
    return not _is_done(directory, key) and bool(
        key.is_clip or parts_of(directory, key)
    )


def _is_done(directory: Path, key: RecordingKey) -> bool:
    """Return whether this is an episode with a finished trajectory and video."""
    if key.is_clip or not is_done(directory / key.video_name):
        return False
    return is_finished(directory / f"{key.name}{FINISHED}")


def look_at(directory: Path, key: RecordingKey) -> Plan | None:
    """Return the work left to do on a recording; None if there is none.

    A recording is left to its monitor if it is still running, or if the monitor has not
    decided yet whether it gets a video. In both cases, the monitor's lock is held, and
    the log lacks the episode's end or marks the episode as a candidate.

    Raises:
        UnreadableFile: the rows are missing or damaged, have a newer format, or contain
            an invalid fact.
        OSError: the monitor's lock cannot be examined.
    """
    # Most recordings in a directory are done and need not be opened.
    if _is_done(directory, key):
        return None
    # Check this first, because a part that appears later belongs to an open monitor.
    is_open = is_locked(directory / lock_name(key.infix))
    parts = parts_of(directory, key)
    if not parts:
        return None
    is_log = key.is_clip or not is_finished(parts[0])
    recorded = read_recording(parts)
    first, facts, last = parts[0], recorded.facts[0], recorded.facts[-1]
    if is_log and is_open and ("complete" not in last or last.get("candidate", False)):
        return None
    videos: list[Path] = []
    if key.is_clip or video_facts(facts).get("recording") == "deferred":
        videos = [video_path(first, facts), *further_video_paths(first, facts)]
    if videos and is_done(videos[0]):
        videos = []
    if not (videos or is_log):
        return None
    frames = len(recorded.chosen().indices) if videos else 0
    in_log = map(find_recording, parts if is_log else ())
    return Plan(
        parts=tuple(parts),
        videos=tuple(videos),
        frame_count=frames * len(videos),
        logs=frozenset(each.log for each in in_log if each is not None),
        is_kept=not key.is_clip and facts.get("kept", True),
        model_file=model_file(directory, last) if videos else None,
    )


def claim(directory: Path, key: RecordingKey) -> Lock | None:
    """Acquire the lock of a recording, or return None if another process holds it.

    Raises:
        DirectoryNotWritable: a lock cannot be created in the directory.
    """
    return try_lock(directory / key.lock_name)


def remove_unfinished(video: Path) -> None:
    """Remove the files that a killed renderer left for a deferred video.

    Only the process that holds the recording's lock may call this, so that no other
    process is writing the files.
    """
    for final in (video, frame_hash_path(video), metadata_path(video)):
        for part in unfinished_files(final):
            part.unlink(missing_ok=True)

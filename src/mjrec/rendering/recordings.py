# SPDX-License-Identifier: Apache-2.0
"""The recordings of a directory, and what is left to do about each.

A recording is an episode or a clip, a video that is counted in steps. Its rows are one
part or more: an episode has one, and a clip that goes on across resets one for each
episode. An episode's part may become a file and stay; those of a clip are dropped when
its video is there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
    ClipPart,
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


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be done about a recording.

    Attributes:
        parts: its rows, by the names of their files, in order.
        videos: those that are to be rendered, the first camera's first.
        frame_count: how many frames are to be rendered, of all of these.
        logs: where its rows are, if they are in logs still.
        is_kept: the trajectory stays once the video is there.
        model_file: what has to be there for rendering, if it is known.
    """

    parts: tuple[Path, ...]
    videos: tuple[Path, ...]
    frame_count: int
    logs: frozenset[Path] = frozenset()
    is_kept: bool = True
    model_file: Path | None = None

    @property
    def has_model(self) -> bool:
        """Whether the model is there; while a simulation runs it may be on its way."""
        return self.model_file is None or self.model_file.exists()


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What the parts of a recording say, all together.

    Attributes:
        parts: the files, in order.
        facts: of each part.
        frame_counts: of each part.
        frame_steps: the step of each frame; the frames themselves are counted for a
            clip, because its resets have one and are no steps.
        step_count: of all parts.
        reward: the sum over all steps.
    """

    parts: tuple[Path, ...]
    facts: tuple[Mapping[str, Any], ...]
    frame_counts: tuple[int, ...]
    frame_steps: NDArray[np.int64]
    step_count: int
    reward: float

    @property
    def is_clip(self) -> bool:
        """Whether it is a clip."""
        return ClipPart.parse(self.parts[0].name) is not None

    @property
    def timing(self) -> Mapping[str, Any]:
        """The facts of the first part that has measured the time of a step."""
        known = (facts for facts in self.facts if facts.get("timestep") is not None)
        return next(known, self.facts[0])

    def chosen(self, max_fps: float | Fraction | None = None) -> ChosenFrames:
        """Return which of the frames are wanted, counted over all parts.

        Of an episode only wanted frames are recorded, of a clip all: which of them are
        0, n, 2n ... does not begin anew with each part.
        """
        if self.is_clip and recorded_rate(self.timing) is not None:
            max_fps = max_fps or video_facts(self.facts[0]).get("max_fps")
        max_fps = Fraction(max_fps) if isinstance(max_fps, str) else max_fps
        return chosen_frames(sum(self.frame_counts), self.timing, max_fps)


def read_recording(parts: Sequence[Path]) -> Recorded:
    """Read what the parts of a recording say.

    Raises:
        UnreadableFile: one is missing or damaged.
    """
    facts: list[Mapping[str, Any]] = []
    frame_counts: list[int] = []
    rewards: list[NDArray[np.float64]] = []
    for number, path in enumerate(parts):
        clip = ClipPart.parse(path.name)
        if clip is not None and clip.number != number:
            raise UnreadableFile(path, f"part {number} of its video is not there")
        with open_for_rendering(path) as reader:
            facts.append(reader.facts)
            frame_counts.append(reader.frame_count)
            rewards.append(reader.rewards)
            steps = reader.frame_steps
    if clip is not None:
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
    keys = {key_of(path.name) for path in (*finished, *in_flight)} - {None}
    return sorted(
        (key for key in keys if key is not None),
        key=lambda key: (
            *(key.is_clip, key.infix.monitor_id, key.infix.uid),
            key.number,
        ),
    )


def parts_of(directory: Path, key: RecordingKey) -> list[Path]:
    """Return the rows of a recording, by the names of their files, in order."""
    if not key.is_clip:
        path = find_trajectory(directory, key.infix, key.number)
        return [] if path is None else [path]
    # In which they are in the logs, too.
    in_flight = (each.path for each in recordings_in_flight(directory, key.infix))
    return [path for path in in_flight if key_of(path.name) == key]


def may_be_left(directory: Path, key: RecordingKey) -> bool:
    """Return whether anything may be left to do about a recording, opening no file.

    Where it is not, `look_at` returns None.
    """
    return not _is_done(directory, key) and bool(
        key.is_clip or parts_of(directory, key)
    )


def _is_done(directory: Path, key: RecordingKey) -> bool:
    """Return whether an episode has all that it can have."""
    if key.is_clip or not is_done(directory / key.video_name):
        return False
    return is_finished(directory / f"{key.name}{FINISHED}")


def look_at(directory: Path, key: RecordingKey) -> Plan | None:
    """Return what is left to do about a recording; None where it is nothing.

    One that is still running, or whose monitor has not decided yet whether it
    gets a video, is left to its monitor: its log does not say how it ended, or calls it
    a candidate, and the monitor's lock is held.

    Raises:
        UnreadableFile: its rows are missing or damaged, or of a newer format, or say
            what cannot be.
        OSError: its monitor's lock cannot be looked at.
    """
    # Most of a directory is done, and need not be opened.
    if _is_done(directory, key):
        return None
    # Asked first: a part that comes later is of a monitor that is open.
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
    return Plan(
        parts=tuple(parts),
        videos=tuple(videos),
        frame_count=frames * len(videos),
        logs=_logs_of(parts) if is_log else frozenset(),
        is_kept=not key.is_clip and facts.get("kept", True),
        model_file=model_file(directory, last) if videos else None,
    )


def _logs_of(parts: Iterable[Path]) -> frozenset[Path]:
    found = map(find_recording, parts)
    return frozenset(each.log for each in found if each is not None)


def claim(directory: Path, key: RecordingKey) -> Lock | None:
    """Return the lock of a recording, or None where another process has it.

    Raises:
        DirectoryNotWritable: there can be no lock in the directory.
    """
    return try_lock(directory / key.lock_name)


def remove_unfinished(video: Path) -> None:
    """Remove what a renderer that was killed has left of a deferred video.

    To be called by the process that holds the recording's lock: no other is at it.
    """
    for final in (video, frame_hash_path(video), metadata_path(video)):
        for part in unfinished_files(final):
            part.unlink(missing_ok=True)

# SPDX-License-Identifier: Apache-2.0
"""What is left to do about the recordings of a directory.

An episode is left to do when its trajectory is still a log, though it has ended, or
when its video was deferred and is not there. A clip, a video that is counted in steps,
is left to do as long as it has logs. Whoever does it holds the lock of the episode or
the clip, so that any number of processes can share the work of a directory, and what a
dead one left is taken over.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from ..errors import DirectoryNotWritable
from ..formats.frame_hashes import frame_hash_path
from ..formats.in_flight import recordings_in_flight
from ..formats.locks import Lock, is_locked, try_lock
from ..formats.monitor_directory import (
    Infix,
    episode_of,
    infix_of,
    iter_monitor_files,
    lock_name,
    names_in,
    trajectory_prefix,
    video_lock_name,
    video_prefix,
)
from ..formats.trajectory_file import find_trajectory
from ..formats.video_metadata import is_done, metadata_path
from .recorded_clips import ClipKey, PendingClip, look_at_clip, recorded_clips
from .recorded_facts import model_file, open_for_rendering
from .videos import further_video_paths, video_path

_PART = re.compile(r"[0-9a-f]{8}\.part", re.ASCII)


@dataclass(frozen=True)
class EpisodeKey:
    """Which episode of a directory.

    Attributes:
        infix: of its monitor.
        episode_id: its number.
    """

    infix: Infix
    episode_id: int

    @classmethod
    def of(cls, name: str) -> EpisodeKey | None:
        """Return that of the episode whose file has this name; None for other files."""
        infix = Infix.parse(infix_of(name) or "")
        number = episode_of(name)
        return None if infix is None or number is None else cls(infix, number)

    @property
    def lock_name(self) -> str:
        """The name of what whoever is at it holds locked."""
        return video_lock_name(self.infix, self.episode_id)

    @property
    def trajectory_name(self) -> str:
        """The base name of the trajectory without extension."""
        return trajectory_prefix(self.infix, self.episode_id)

    @property
    def recording_name(self) -> str:
        """The base name of the trajectory, as logs call it."""
        return self.trajectory_name

    @property
    def told_name(self) -> str:
        """What it is called where nothing is known of it."""
        return self.video_name

    @property
    def video_name(self) -> str:
        """The base name that its video usually has."""
        return f"{video_prefix(self.infix, self.episode_id)}.mp4"


@dataclass(frozen=True, kw_only=True)
class PendingEpisode:
    """An episode that is left to do.

    Attributes:
        key: which one.
        trajectory: its file.
        video: what is to be rendered; None where nothing is.
        further_videos: what is to be rendered besides, of further cameras.
        frame_count: how many frames are to be rendered, of all of these.
        is_kept: the trajectory stays once the video is there.
        model_file: what has to be there for rendering, if it is known.
    """

    key: EpisodeKey
    trajectory: Path
    video: Path | None
    frame_count: int
    is_kept: bool
    model_file: Path | None
    further_videos: tuple[Path, ...] = ()

    @property
    def video_count(self) -> int:
        """How many videos are to be rendered."""
        return int(self.video is not None) + len(self.further_videos)

    @property
    def is_log(self) -> bool:
        """Whether the trajectory has not got its final form yet."""
        return not self.trajectory.is_file()


RecordingKey: TypeAlias = EpisodeKey | ClipKey
PendingRecording: TypeAlias = PendingEpisode | PendingClip


def key_of(name: str) -> RecordingKey | None:
    """Return that of the episode or clip that a file is of; None for other files."""
    return ClipKey.of(name) or EpisodeKey.of(name)


def recordings(directory: Path) -> list[RecordingKey]:
    """Return the episodes that have a trajectory, and the clips in flight."""
    return [*recorded_episodes(directory), *recorded_clips(directory)]


def recorded_episodes(directory: Path) -> list[EpisodeKey]:
    """Return the episodes that have a trajectory, monitor by monitor, in order."""
    finished = (path for path in iter_monitor_files(directory) if path.suffix == ".h5")
    in_flight = (each.path for each in recordings_in_flight(directory))
    keys = {
        key
        for path in (*finished, *in_flight)
        if path.suffix == ".h5" and (key := EpisodeKey.of(path.name)) is not None
    }
    return sorted(
        keys, key=lambda key: (key.infix.monitor_id, key.infix.uid, key.episode_id)
    )


def look_at(directory: Path, key: RecordingKey) -> PendingRecording | None:
    """Return what is left to do about a recording; None where it is nothing.

    An episode that is still running, or of which its monitor has not decided yet
    whether it gets a video, is nobody's business but its monitor's: its log does not
    say how it ended, or calls it a candidate, and somebody holds the monitor's lock.

    Raises:
        UnreadableFile: its trajectory is damaged, or of a newer format, or says what
            cannot be.
        OSError: its monitor's lock cannot be looked at.
    """
    if isinstance(key, ClipKey):
        return look_at_clip(directory, key)
    return _look_at_episode(directory, key)


def may_be_left(directory: Path, key: RecordingKey) -> bool:
    """Tell whether anything may be left to do about a recording, opening no file.

    Where it is not, `look_at` returns None.
    """
    return isinstance(key, ClipKey) or _not_done(directory, key) is not None


def _not_done(directory: Path, key: EpisodeKey) -> Path | None:
    """Return the trajectory of an episode; None where there is nothing left to do."""
    trajectory = find_trajectory(directory, key.infix, key.episode_id)
    if trajectory is None or not trajectory.is_file():
        return trajectory
    return None if is_done(directory / key.video_name) else trajectory


def _look_at_episode(directory: Path, key: EpisodeKey) -> PendingEpisode | None:
    # Most of a directory is done, and need not be opened.
    trajectory = _not_done(directory, key)
    if trajectory is None:
        return None
    is_log = not trajectory.is_file()
    with open_for_rendering(trajectory) as reader:
        facts = reader.header.facts
        if is_log and _is_monitors(facts) and _is_open(directory, key.infix):
            return None
        video = _deferred_video(trajectory, facts)
        if not is_log and video is None:
            return None
        further = () if video is None else further_video_paths(trajectory, facts)
        return PendingEpisode(
            key=key,
            trajectory=trajectory,
            video=video,
            further_videos=tuple(further),
            frame_count=0 if video is None else reader.frame_count * (1 + len(further)),
            is_kept=facts.get("kept", True),
            model_file=model_file(directory, facts),
        )


def claim(directory: Path, key: RecordingKey) -> Lock | None:
    """Return the lock of a recording, or None where another process has it.

    Raises:
        DirectoryNotWritable: there can be no lock in the directory.
    """
    try:
        return try_lock(directory / key.lock_name, f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error


def remove_unfinished(video: Path) -> None:
    """Remove what a renderer that was killed has left of a deferred video.

    To be called by who holds the recording's lock, so that nobody else is at it.
    """
    finals = (video, frame_hash_path(video), metadata_path(video))
    begins = tuple(f".{final.name}." for final in finals)
    # Many names, of whole directories, are compared once for each video.
    for name in names_in(video.parent):
        if name.startswith(begins) and any(
            name.startswith(begin) and _PART.fullmatch(name, len(begin))
            for begin in begins
        ):
            video.with_name(name).unlink(missing_ok=True)


def _is_monitors(facts: Mapping[str, Any]) -> bool:
    return "complete" not in facts or bool(facts.get("candidate", False))


def _is_open(directory: Path, infix: Infix) -> bool:
    return is_locked(directory / lock_name(infix))


def _deferred_video(trajectory: Path, facts: Mapping[str, Any]) -> Path | None:
    video = facts.get("video") or {}
    if video.get("recording") != "deferred":
        return None
    path = video_path(trajectory, facts)
    return None if is_done(path) else path

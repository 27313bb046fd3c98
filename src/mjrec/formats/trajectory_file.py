# SPDX-License-Identifier: Apache-2.0
"""A recorded episode, in flight still or an HDF5 file already."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from .journal import KILLED
from .json_fields import unreadable
from .monitor_directory import Infix, trajectory_prefix
from .regular_files import open_regular
from .spans import FINISHED, Recording, find_recording, remove_if_done
from .trajectory import TrajectoryReader, added_up
from .trajectory_hdf5 import SIGNATURE, open_hdf5, write_hdf5
from .trajectory_log import open_recording


def open_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory for reading, whichever of its two forms it has.

    Args:
        path: of the finished file, which need not be there yet; or the name of a
            clip's part, which never becomes a file.

    Raises:
        UnreadableFile: there is neither such a file nor a log of it, or it is damaged,
            or of a newer format version.
    """
    if not path.is_file() and find_recording(path) is not None:
        try:
            return open_recording(path)
        except UnreadableFile:
            if not path.is_file():
                raise
            # It was finished just now.
    with unreadable(path), open_regular(path) as file:
        if file.read(len(SIGNATURE)) != SIGNATURE:
            raise ValueError("it is no trajectory")
    return open_hdf5(path)


def find_trajectory(
    directory: Path, infix: Infix | str, episode_id: int
) -> Path | None:
    """Return the file of an episode, which may be in flight still; None without any."""
    known = infix if isinstance(infix, Infix) else Infix.parse(infix)
    if known is None:
        return None
    path = directory / f"{trajectory_prefix(known, episode_id)}{FINISHED}"
    is_there = path.is_file() or find_recording(path) is not None
    return path if is_there else None


def finish_trajectory(path: Path) -> Path:
    """Make the HDF5 file of an ended recording; its rows are not needed then.

    One that does not say how it ended is that of a process that was killed, or whose
    disk was full: its last row tells whether all of it is there. This may be killed at
    any point and run again, and two may do it at the same time: the rows are there
    until the file is.

    Args:
        path: of the file.

    Returns:
        The path.

    Raises:
        UnreadableFile: there is neither, or the log cannot be read; it stays.
        FileNotWritten: the disk is full; the log stays.
        DirectoryNotWritable: the log cannot be removed.
    """
    recording = find_recording(path)
    if not path.is_file():
        try:
            with open_recording(path) as reader:
                reader.facts = {**reader.facts, **_how_it_ended(reader, recording)}
                write_hdf5(reader, path)
        except UnreadableFile:
            if not path.is_file():
                raise
            # Somebody else finished it just now.
    if recording is not None:
        remove_if_done(recording.log)
    return path


def amend_trajectory(finished: Path, change: Callable[[Any], Any]) -> None:
    """Change the facts of a finished trajectory.

    The file is written anew, whole or not at all: for what is seldom done. Nothing is
    in it that this package does not write; its arrays stay, bit for bit.

    Args:
        finished: the HDF5 file.
        change: returns the new facts.

    Raises:
        UnreadableFile: there is no such file, or it is damaged.
        FileNotWritten: the disk is full; the file is as before.
    """
    with open_hdf5(finished) as reader:
        reader.facts = change(dict(reader.facts))
        write_hdf5(reader, finished)


def _end_time(facts: Mapping[str, Any], recording: Recording | None) -> float:
    """Return about when an episode ended, and not before it began.

    What is written into a mapped file may change its time much later, or never.
    """
    start, last = facts.get("start_time"), 0.0
    if recording is not None:
        last = recording.last_write
    return max(start, last) if isinstance(start, float) else last


def _how_it_ended(
    reader: TrajectoryReader, recording: Recording | None
) -> dict[str, Any]:
    """Return what its rows say of an episode's end; nothing where it is said."""
    facts = reader.facts
    if "complete" in facts:
        return {}
    known: dict[str, Any] = {
        "complete": False,
        "length": reader.step_count,
        "reward": added_up(reader.rewards),
    }
    if reader.step_count and (reader.terminated[-1] or reader.truncated[-1]):
        # All of it is there but the last words, which a kill or a full disk cut off.
        known |= {
            "complete": True,
            "terminated": bool(reader.terminated[-1]),
            "truncated": bool(reader.truncated[-1]),
            "end_time": _end_time(facts, recording),
        }
    else:
        known["reason"] = KILLED
    video = facts.get("video")
    is_deferred = isinstance(video, dict) and video.get("recording") == "deferred"
    if is_deferred and not reader.frame_count:
        # So that nobody waits for a video of nothing.
        known["broken_reason"] = "the process was killed before its first frame"
    return known

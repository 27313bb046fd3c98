# SPDX-License-Identifier: Apache-2.0
"""A recorded episode: in flight still, an HDF5 file, or a group of a bundle."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ..errors import Error, UnreadableFile
from .bundle import bundle_of, file_of, is_finished
from .journal import KILLED
from .json_fields import unreadable
from .regular_files import open_regular
from .spans import Recording, find_recording, is_in_flight, remove_if_done
from .trajectory import TrajectoryReader, added_up
from .trajectory_hdf5 import SIGNATURE, open_hdf5, write_bundle, write_hdf5
from .trajectory_log import open_recording


def open_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory for reading, whichever of its forms it has.

    Args:
        path: of its own file, which need not be there; or the name of a clip's part,
            which never becomes a file.

    Raises:
        UnreadableFile: there is neither such a file nor a log of it, or it is damaged,
            or of a newer format version.
    """
    if not is_finished(path) and find_recording(path) is not None:
        try:
            return open_recording(path)
        except UnreadableFile:
            if not is_finished(path):
                raise
            # It was finished just now.
    if (holder := file_of(path)) == path:
        with unreadable(path), open_regular(holder) as file:
            if file.read(len(SIGNATURE)) != SIGNATURE:
                raise ValueError("it is no trajectory")
    return open_hdf5(path)


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
    if not is_finished(path):
        try:
            with _ended(path, recording) as reader:
                write_hdf5(reader, path)
        except UnreadableFile:
            if not path.is_file():
                raise
            # Another process finished it just now.
    if recording is not None:
        remove_if_done(recording.log)
    return path


def finish_trajectories(paths: Iterable[Path]) -> dict[Path, Error]:
    """Finish recordings that are in flight, and return why others could not be."""
    failures: dict[Path, Error] = {}
    for path in paths:
        try:
            if is_in_flight(path):
                finish_trajectory(path)
        except Error as error:
            failures[path] = error
    return failures


def bundle_trajectories(paths: Iterable[Path]) -> dict[Path, Error]:
    """Do so, and put them into the bundle of their monitor, written once for all.

    To be called by the process that holds the lock of the monitor that they are of.
    """
    recordings: dict[Path, Recording] = {}
    failures: dict[Path, Error] = {}
    for path in paths:
        try:
            recording = None if is_finished(path) else find_recording(path)
        except UnreadableFile as error:
            failures[path] = error
        else:
            recordings |= {} if recording is None else {path: recording}
    if not recordings:
        return failures
    added = {p: functools.partial(_ended, p, each) for p, each in recordings.items()}
    try:
        failures |= write_bundle(bundle_of(next(iter(added))), added, {})
        for log in {each.log for each in recordings.values()}:
            remove_if_done(log)
    except Error as error:
        failures |= dict.fromkeys(recordings, error)
    return failures


def amend_trajectories(changes: Mapping[Path, Callable[[Any], Any]]) -> None:
    """Change the facts of finished trajectories.

    Each file is written anew, whole or not at all: for what is seldom done. Nothing is
    in it that this package does not write; its arrays stay, bit for bit.

    Args:
        changes: returns the new facts, by the path of the trajectory's own file.

    Raises:
        UnreadableFile: there is no such file, or it is damaged.
        FileNotWritten: the disk is full; the file is as before.
    """
    bundled: dict[Path, dict[Path, Callable[[Any], Any]]] = {}
    for path, change in changes.items():
        holder = file_of(path)
        if holder != path:
            bundled.setdefault(holder, {})[path] = change
            continue
        with open_hdf5(path) as reader:
            reader.facts = change(dict(reader.facts))
            write_hdf5(reader, path)
    for bundle, own in bundled.items():
        write_bundle(bundle, {}, own)


def _ended(path: Path, recording: Recording | None) -> TrajectoryReader:
    """Open a recording whose facts say how it ended."""
    reader = open_recording(path)
    reader.facts = {**reader.facts, **_how_it_ended(reader, recording)}
    return reader


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
        # So that no process waits for a video of nothing.
        known["broken_reason"] = "the process was killed before its first frame"
    return known

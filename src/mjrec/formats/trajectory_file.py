# SPDX-License-Identifier: Apache-2.0
"""Access to recorded episodes in flight, in HDF5 files and in bundles."""

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
    """Open a trajectory for reading, in any of its forms.

    Args:
        path: the trajectory's own file, which need not exist; or the name of a clip's
            part, which never becomes a file.

    Raises:
        UnreadableFile: neither the file nor a log of the recording exists, or it is
            damaged or has a newer format version.
    """
    if not is_finished(path) and find_recording(path) is not None:
        try:
            return open_recording(path)
        except UnreadableFile:
            if not is_finished(path):
                raise
            # Another process has just finished it.
    if (holder := file_of(path)) == path:
        with unreadable(path), open_regular(holder) as file:
            if file.read(len(SIGNATURE)) != SIGNATURE:
                raise ValueError("it is not a trajectory")
    return open_hdf5(path)


def finish_trajectory(path: Path) -> Path:
    """Create the HDF5 file of an ended recording, and remove its log if it is done.

    If the end of a recording was not recorded, the process was killed or the disk was
    full; the last row then shows whether the recording is complete. This function can
    be killed at any point and run again, and two processes can run it at the same time,
    because the rows stay until the file exists.

    Args:
        path: the trajectory's own file.

    Returns:
        The path.

    Raises:
        UnreadableFile: neither the file nor a log exists, or the log cannot be read;
            the log stays.
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
            # Another process has just finished it.
    if recording is not None:
        remove_if_done(recording.log)
    return path


def finish_trajectories(paths: Iterable[Path]) -> dict[Path, Error]:
    """Finish the recordings that are in flight, and return the errors by path."""
    failures: dict[Path, Error] = {}
    for path in paths:
        try:
            if is_in_flight(path):
                finish_trajectory(path)
        except Error as error:
            failures[path] = error
    return failures


def bundle_trajectories(paths: Iterable[Path]) -> dict[Path, Error]:
    """Finish recordings by adding them to their monitor's bundle all at once.

    Call this only in the process that holds the monitor's lock.

    Args:
        paths: the trajectories' own files, all from one monitor.

    Returns:
        The error of each trajectory that could not be added, by path.
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

    Each file is atomically rewritten as a whole, so use this rarely. Only data that
    this package writes is kept; the arrays stay the same, bit for bit.

    Args:
        changes: functions that take a trajectory's facts and return the new facts, by
            the path of the trajectory's own file.

    Raises:
        UnreadableFile: the file is missing or damaged.
        FileNotWritten: the disk is full; the file is unchanged.
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
    """Open a recording, and add facts about how it ended."""
    reader = open_recording(path)
    reader.facts = {**reader.facts, **_how_it_ended(reader, recording)}
    return reader


def _how_it_ended(
    reader: TrajectoryReader, recording: Recording | None
) -> dict[str, Any]:
    """Derive facts about an episode's end from its rows, if its facts lack them.

    The last row shows whether a killed process had completed the episode. If so, it
    counts like any other. Otherwise, it has `complete: false` and `reason: "killed"`,
    keeps all rows up to the kill, and is not in the statistics.

    Args:
        reader: the reader of the episode's rows.
        recording: the episode's recording in the row log; None if the log is gone.
    """
    facts = reader.facts
    if "complete" in facts:
        return {}
    known: dict[str, Any] = {
        "complete": False,
        "length": reader.step_count,
        "reward": added_up(reader.rewards),
    }
    if reader.step_count and (reader.terminated[-1] or reader.truncated[-1]):
        # Only the end event is missing, because of a kill or a full disk.
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
        # Prevent any process from waiting for a video without frames.
        known["broken_reason"] = "the process was killed before its first frame"
    return known


def _end_time(facts: Mapping[str, Any], recording: Recording | None) -> float:
    """Return the approximate time when an episode ended, never before its start.

    The modification time of a mapped file may be updated late or never.
    """
    start, last = facts.get("start_time"), 0.0
    if recording is not None:
        last = recording.last_write
    return max(start, last) if isinstance(start, float) else last

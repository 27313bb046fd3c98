# SPDX-License-Identifier: Apache-2.0
"""Access to recorded episodes, whether in flight, in HDF5 files or in bundles."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ..errors import Error, UnreadableFile
from .bundle import bundle_of, file_of, is_finished
from .json_fields import unreadable
from .killed_episodes import how_it_ended
from .regular_files import open_regular
from .spans import Recording, find_recording, is_in_flight, remove_if_done
from .trajectory import TrajectoryReader
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
    """Create an ended recording's HDF5 file, and remove its log if no longer needed.

    If the end of a recording was not recorded, the process was killed or the disk was
    full. The last row then shows whether the recording is complete. This function can
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
    """Finish the recordings that are in flight, and return the errors keyed by path."""
    failures: dict[Path, Error] = {}
    for path in paths:
        try:
            if is_in_flight(path):
                finish_trajectory(path)
        except Error as error:
            failures[path] = error
    return failures


def bundle_trajectories(paths: Iterable[Path]) -> dict[Path, Error]:
    """Finish recordings by adding them to their monitor's bundle in one step.

    Call this only in the process that holds the monitor's lock.

    Args:
        paths: the trajectories' own files, all from one monitor.

    Returns:
        The error for each trajectory that could not be added, keyed by path.
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
    this package writes is kept. The arrays stay the same, bit for bit.

    Args:
        changes: functions that take a trajectory's facts and return the new facts,
            keyed by the path of the trajectory's own file.

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
    reader.facts = {**reader.facts, **how_it_ended(reader, recording)}
    return reader

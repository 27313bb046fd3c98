# SPDX-License-Identifier: Apache-2.0
"""The file of a recorded episode, be it a log still or HDF5 already."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import DirectoryNotWritable, InvalidArgument, UnreadableFile
from .json_fields import unreadable
from .monitor_directory import Infix, trajectory_prefix
from .regular_files import open_regular
from .trajectory_hdf5 import SIGNATURE, TrajectoryHdf5Reader, write_hdf5
from .trajectory_log_reader import TrajectoryLogReader
from .trajectory_reader import TrajectoryReader, added_up

_LOG = ".log"
_FINISHED = ".h5"


def open_trajectory(path: Path) -> TrajectoryReader:
    """Open a trajectory for reading, whichever of its two forms it has.

    What a file is, its first bytes tell. A log that was finished meanwhile is opened
    as what it has become.

    Raises:
        UnreadableFile: there is no such file, or it is none, or damaged, or of a
            newer format version.
    """
    if path.suffix == _LOG and not path.exists():
        finished = path.with_suffix(_FINISHED)
        path = finished if finished.exists() else path
    with unreadable(path), open_regular(path) as file:
        is_finished = file.read(len(SIGNATURE)) == SIGNATURE
    return TrajectoryHdf5Reader(path) if is_finished else TrajectoryLogReader(path)


def find_trajectory(
    directory: Path, infix: Infix | str, episode_id: int
) -> Path | None:
    """Return the file of an episode: finished if it is, else the log, else None."""
    known = infix if isinstance(infix, Infix) else Infix.parse(infix)
    if known is None:
        return None
    prefix = trajectory_prefix(known, episode_id)
    log, finished = (directory / f"{prefix}{end}" for end in (_LOG, _FINISHED))
    # The log is looked for first: while one becomes the other there is always one.
    is_log = log.is_file()
    if finished.is_file():
        return finished
    return log if is_log else None


def finish_trajectory(log: Path, *, facts: Mapping[str, Any] | None = None) -> Path:
    """Make the HDF5 file of an ended log, and remove the log.

    A log that does not say how its episode ended is that of a process that was killed,
    and the file says so. This may be killed at any point and run again, and two may do
    it at the same time: the log is there until the file is.

    Args:
        log: its path.
        facts: what else is known of the episode, and counts more than the log.

    Returns:
        The path of the HDF5 file.

    Raises:
        InvalidArgument: its name is not that of a log.
        UnreadableFile: there is neither, or the log cannot be read; it stays.
        FileNotWritten: the disk is full; the log stays.
        DirectoryNotWritable: the log cannot be removed.
    """
    if log.suffix != _LOG:
        raise InvalidArgument(
            f"The name of a trajectory's log ends in {_LOG}, got {str(log)!r}."
        )
    finished = log.with_suffix(_FINISHED)
    if not _is_whole(finished):
        _convert(log, finished, facts or {})
    try:
        log.unlink(missing_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(log.parent, error) from error
    return finished


def amend_trajectory(finished: Path, facts: Mapping[str, Any]) -> None:
    """Add to the facts of a finished trajectory; of a key, the new value counts.

    The file is written anew, whole or not at all: for what is seldom done.

    Args:
        finished: the HDF5 file.
        facts: what to add.

    Raises:
        UnreadableFile: there is no such file, or it is damaged.
        FileNotWritten: the disk is full; the file is as before.
    """
    with TrajectoryHdf5Reader(finished) as reader:
        known = {**reader.header.facts, **facts}
        reader.header = dataclasses.replace(reader.header, facts=known)
        write_hdf5(reader, finished)


def _convert(log: Path, finished: Path, facts: Mapping[str, Any]) -> None:
    try:
        with TrajectoryLogReader(log) as reader:
            known = {**reader.header.facts, **facts}
            known.update(_how_it_ended(reader, known))
            reader.header = dataclasses.replace(reader.header, facts=known)
            write_hdf5(reader, finished)
    except UnreadableFile:
        # Somebody else may have done it and removed the log meanwhile.
        if not _is_whole(finished):
            raise


def _how_it_ended(
    reader: TrajectoryLogReader, facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what there is to say where nobody could say it."""
    if "complete" in facts:
        return {}
    known: dict[str, Any] = {
        "complete": False,
        "reason": "killed",
        "length": reader.step_count,
        "reward": added_up(reader.rewards),
    }
    video = facts.get("video")
    is_deferred = isinstance(video, dict) and video.get("recording") == "deferred"
    if is_deferred and not reader.frame_count:
        # So that nobody waits for a video of nothing.
        known["broken_reason"] = "the process was killed before its first frame"
    return known


def _is_whole(path: Path) -> bool:
    """Tell whether there is a finished trajectory that can be opened."""
    with contextlib.suppress(UnreadableFile), TrajectoryHdf5Reader(path):
        return True
    return False

# SPDX-License-Identifier: Apache-2.0
"""Recordings in flight: those that only the logs of a directory have.

Each is called by the path of the file that it will become.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import DirectoryNotWritable, UnreadableFile
from .json_fields import unreadable
from .locks import is_locked
from .monitor_directory import Infix, infix_of, lock_name, names_in
from .row_log import tail_path
from .spans import (
    FINISHED,
    LOG,
    LOOKS,
    SPANS,
    Recording,
    SpanList,
    append_line,
    infix_of_recording,
)

# Lists that were read are kept, for all threads. A process is forked at none of them.
_reading = threading.RLock()
os.register_at_fork(
    before=_reading.acquire,
    after_in_parent=_reading.release,
    after_in_child=_reading.release,
)


def lists_in(directory: Path, infix: Infix | str | None = None) -> list[SpanList]:
    """Return the lists of a directory, or of one monitor in it, in their order.

    Those that cannot be read are left out: `read_list` says why.
    """
    found = []
    for path in list_paths(directory, infix):
        with contextlib.suppress(UnreadableFile):
            found.append(read_list(path))
    return found


def list_paths(directory: Path, infix: Infix | str | None = None) -> Iterator[Path]:
    """Return the paths of the lists of a directory, or of one monitor in it."""
    wanted = None if infix is None else str(infix)
    for name in _list_names(directory):
        own = infix_of(name)
        if own is not None and wanted in (None, own):
            yield directory / name


# By directory: when it had changed last, and the names that it had then.
_listed: dict[Path, tuple[int, list[str]]] = {}
# A directory's time stands still for moments in which it changes.
_SETTLED_NS = 1_000_000_000


def _list_names(directory: Path) -> list[str]:
    """Return the names of the lists in a directory, sorted.

    Each recording in flight is looked for by itself, and a directory may have
    thousands of files.
    """
    before, now = directory.stat().st_mtime_ns, time.time_ns()
    changed, names = _listed.get(directory, (-1, []))
    if changed != before:
        names = sorted(name for name in names_in(directory) if name.endswith(SPANS))
        _listed.clear()
        if now - before > _SETTLED_NS:
            _listed[directory] = (before, names)
    return names


def read_list(path: Path) -> SpanList:
    """Return a list as it is now.

    Raises:
        UnreadableFile: it is no such list, or of a newer format, or there is no such
            file.
    """
    with _reading, unreadable(path):
        status = path.stat()
        spans = _known_list(path, status.st_dev, status.st_ino)
        if not spans.read_on(status):
            _known_list.cache_clear()
            spans = _known_list(path, status.st_dev, status.st_ino)
            spans.read_on(status)
        return spans


@functools.lru_cache(maxsize=32)
def _known_list(path: Path, device: int, inode: int) -> SpanList:
    del device, inode
    return SpanList(path)


def find_recording(path: Path) -> Recording | None:
    """Return a recording that is not dropped, by the path of its file; None where none.

    Raises:
        UnreadableFile: no list has it, and one of its monitor's cannot be read.
    """
    name = path.name.removesuffix(FINISHED)
    infix = infix_of_recording(name)
    if infix is None or not path.parent.is_dir():
        return None
    found, damage = None, None
    for each in list_paths(path.parent, infix):
        try:
            recording = read_list(each).recordings.get(name)
        except UnreadableFile as error:
            # A list that was removed just now had nothing in flight.
            damage = error if os.path.lexists(each) else damage
            continue
        if recording is not None and not recording.is_dropped:
            found = recording
    if found is None and damage is not None:
        raise damage
    return found


def get_recording(path: Path) -> Recording:
    """Return a recording that is not dropped, by the path of its file.

    Raises:
        UnreadableFile: there is none, or a list cannot be read.
    """
    recording = find_recording(path)
    if recording is None:
        raise UnreadableFile(path, "there is no such file, and no log of it")
    return recording


def is_in_flight(path: Path) -> bool:
    """Tell whether a recording is in a log only, by the path of its file.

    Raises:
        UnreadableFile: as `find_recording`.
    """
    if path.suffix == FINISHED and path.is_file():
        return False
    return find_recording(path) is not None


def recordings_in_flight(
    directory: Path, infix: Infix | str | None = None
) -> list[Recording]:
    """Return the recordings that only logs have, of all monitors or one."""
    return [each for spans in lists_in(directory, infix) for each in spans.in_flight()]


def add_facts(path: Path, facts: Mapping[str, Any]) -> None:
    """Add to the facts of a recording in flight; of a key, the newest counts.

    Raises:
        UnreadableFile: there is no such recording.
        FileNotWritten: the disk is full; nothing was added.
    """
    recording = get_recording(path)
    append_line(recording.spans.path, {"note": recording.name, "facts": dict(facts)})


def drop_recording(path: Path) -> None:
    """Give up the rows of a recording; it is no error where there are none.

    Raises:
        FileNotWritten: the disk is full.
        DirectoryNotWritable: files cannot be removed.
    """
    recording = find_recording(path)
    if recording is not None:
        append_line(recording.spans.path, {"drop": recording.name})
        remove_if_done(recording.spans.path)


def remove_if_done(path: Path) -> None:
    """Remove a list and its logs once the log is closed and nothing is in flight.

    Raises:
        DirectoryNotWritable: they cannot be removed.
    """
    # Asked first: a monitor that is closed begins nothing any more.
    is_open = _is_open(path)
    try:
        spans = read_list(path)
    except UnreadableFile:
        return
    is_over = spans.is_closed or not is_open
    if is_over and not spans.in_flight() and not spans.is_headless:
        remove_list(path)


def remove_list(path: Path) -> None:
    """Remove a list and its logs.

    Raises:
        DirectoryNotWritable: they cannot be removed.
    """
    log = path.with_suffix(LOG)
    try:
        # The log first, so that no reader opens it without the rest; the list last,
        # because the others are found through it.
        for each in (log, tail_path(log), path.with_suffix(LOOKS), path):
            each.unlink(missing_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(path.parent, error) from error


def _is_open(path: Path) -> bool:
    infix = Infix.parse(infix_of(path.name) or "")
    try:
        return infix is not None and is_locked(path.parent / lock_name(infix))
    except OSError:
        # Unknown: leave its files alone.
        return True

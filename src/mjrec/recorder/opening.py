# SPDX-License-Identifier: Apache-2.0
"""Functions that open a monitor directory, which may be new, resumed, or cleared.

Opening claims an infix, which then identifies one monitor. The claim is a lock file
that is created with `O_EXCL` and held with `flock` while the monitor is open. A lock
file that exists but is not held belongs to a dead monitor.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .. import json_text
from ..errors import DifferentEnvironment, DirectoryNotWritable, ExistingRecordings
from ..formats.locks import Lock, is_locked
from ..formats.monitor_directory import (
    check_uid,
    infix_of,
    iter_monitor_files,
    journal_name,
    lock_name,
    manifest_name,
)
from ..results import clear_monitor_files
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import monitors_of
from .options import JOIN, RecorderOptions

# Counts the monitors in this process.
_monitor_ids = itertools.count()


def open_directory(
    path: Path, options: RecorderOptions, facts: Mapping[str, Any]
) -> tuple[str, Lock, Mapping[str, Any]]:
    """Claim an infix in a directory, which is created if it is missing.

    With `resume`, episode numbers continue after the highest number of all closed or
    dead monitors, or only of those with the same `uid` if it is given. Monitors that
    are still open do not count. With `JOIN`, the files of other monitors are not read,
    however many there are. The caller then guarantees that all monitors record the same
    environment, and episodes are numbered from 0. `force` overrides `resume`.

    Args:
        path: absolute path of the monitor directory.
        options: the user's options.
        facts: the facts about the run, including its `env_info`. They are written to
            the lock file, so they survive even if the process is killed before it
            writes to the journal.

    Returns:
        The claimed infix, its lock, which is held until the monitor closes, and the
        run's facts, including the number of the first episode, `first_episode_id`.

    Raises:
        ExistingRecordings: the directory contains recordings, and neither `force` nor
            `resume` was given.
        DirectoryInUse: `force` was given while another monitor is recording in the
            directory.
        DifferentEnvironment: `resume` was given, but the recordings are from a
            different environment.
        DirectoryNotWritable: the directory cannot be created or written to.
        InvalidArgument: `uid` cannot be part of a file name.
    """
    uid = None if options.uid is None else check_uid(options.uid)
    joins = options.resume == JOIN and not options.force
    with made_directory(path):
        _check_existing(path, options, env_id=facts["env_info"]["env_id"])
        if (original := options.statements) is not None:
            run = {**facts, "first_episode_id": original.first_episode_id}
            content = json_text.dumps({"run": run})
            return original.infix, Lock(path / lock_name(original.infix), content), run
        numbers_on = not (options.force or joins)
        first = _next_episode_id(path, uid=uid) if numbers_on else 0
        run = {**facts, "first_episode_id": first}
        return *_claim(path, uid=uid, run=run, looks=not joins), run


@contextlib.contextmanager
def made_directory(path: Path) -> Iterator[None]:
    """Create a directory and its parents, and remove them if the block raises.

    Directories that already existed are not removed.

    Raises:
        DirectoryNotWritable: the directory cannot be created or written to.
    """
    try:
        missing = [p for p in (path, *path.parents) if not p.exists()]
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(path, error.strerror) from error
    try:
        if not os.access(path, os.W_OK | os.X_OK):
            raise DirectoryNotWritable(path, "permission denied")
        yield
    except BaseException:
        for made in missing:
            # The directory is kept if other files have been added in the meantime.
            with contextlib.suppress(OSError):
                made.rmdir()
        raise


def _check_existing(path: Path, options: RecorderOptions, *, env_id: str) -> None:
    if options.force:
        clear_monitor_files(path)
        return
    if options.resume == JOIN:
        return
    existing = [file.name for file in iter_monitor_files(path, hidden=True)]
    if existing and not options.resume:
        raise ExistingRecordings(path, existing)
    for files in monitors_of(path):
        recorded = (MonitorResults(files).env_info or {}).get("env_id")
        if isinstance(recorded, str) and recorded != env_id:
            raise DifferentEnvironment(path, recorded, env_id)


def _next_episode_id(path: Path, *, uid: str | None) -> int:
    """Return the number after the highest episode number of all closed monitors."""
    highest = -1
    for files in monitors_of(path):
        if uid is not None and files.infix.partition(".")[2] != uid:
            continue
        if not is_locked(path / lock_name(files.infix)):
            # File names count as well, because an episode that was running when its
            # process died also has a number.
            results = MonitorResults(files)
            last = (files.last_episode_id, results.run.last_episode_id)
            highest = max(highest, *last, _last_counted(results))
    return highest + 1


def _last_counted(results: MonitorResults) -> int:
    """Return the last episode number that the manifest states or implies, or -1."""
    if results.details:
        return int(results.details.get("next_episode_id") or 0) - 1
    # A manifest without these facts was written by gym. Resets number the episodes from
    # 0, and each reset has a type.
    stats = None if results.manifest is None else results.saved
    if stats is None:
        return -1
    return max(len(stats.timestamps), len(stats.episode_types or ())) - 1


def _claim(
    path: Path, *, uid: str | None, run: Mapping[str, Any], looks: bool
) -> tuple[str, Lock]:
    """Claim a new infix for this monitor, and return the infix with its lock.

    Args:
        path: the directory.
        uid: string to use in the infix instead of the process id. The infix's number
            then depends on the directory, so that names are the same in every process.
        run: the run's facts.
        looks: whether to look for any file with the infix. Otherwise, only manifests,
            journals and locks are considered. Each monitor leaves at least one of these
            files.
    """
    content = json_text.dumps({"pid": os.getpid(), "since": time.time(), "run": run})
    of_directory = itertools.count()
    while True:
        number = next(_monitor_ids if uid is None else of_directory)
        infix = f"{number}.{uid or os.getpid()}"
        if _is_taken(path, infix, looks=looks):
            continue
        try:
            lock = Lock(path / lock_name(infix), content)
        except FileExistsError:
            continue
        except OSError as error:
            raise DirectoryNotWritable(path, error.strerror) from error
        # The previous monitor with this infix may have closed and released its lock
        # after the first check, before the lock was taken here.
        if not _is_taken(path, infix, besides=lock_name(infix), looks=looks):
            return infix, lock
        lock.release()


def _is_taken(
    path: Path, infix: str, *, looks: bool, besides: str | None = None
) -> bool:
    # A pid or uid is rarely used twice. Every closed monitor has left a manifest, so
    # there is usually no need to list the whole directory.
    if (path / manifest_name(infix)).exists() or (path / journal_name(infix)).exists():
        return True
    return looks and any(
        file.name != besides and infix_of(file.name) == infix
        for file in iter_monitor_files(path, hidden=True)
    )

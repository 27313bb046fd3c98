# SPDX-License-Identifier: Apache-2.0
"""Opening a monitor directory: new, resumed, or emptied by force.

Opening claims an infix, which stands for one monitor from then on: a lock file made
with `O_EXCL` and held with `flock` while the monitor is open. A lock that is there
but not held is a dead monitor's.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from .. import json_text
from ..errors import (
    DifferentEnvironment,
    DirectoryNotWritable,
    ExistingRecordings,
)
from ..formats.locks import Lock, is_locked
from ..formats.monitor_directory import (
    Infix,
    check_uid,
    infix_of,
    iter_monitor_files,
    journal_name,
    lock_name,
    manifest_name,
)
from ..results import clear_monitor_files
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, monitors_of

# To record beside monitors that are of the same environment, without a look at them.
JOIN = "join"


# Counts the monitors of this process.
_monitor_ids = itertools.count()


@dataclass(frozen=True, kw_only=True)
class Statements:
    """What of a run can never come out again: given where a run is made again.

    Attributes:
        infix: what the names of its files have in the middle; it is not claimed yet.
        first_episode_id: the number of its first episode.
        provenance: its provenance; None where that was not known.
        provenance_after: how many lines the journal had before, after its first.
        clock: returns the time, in seconds since the epoch.
        only_counted: episodes without a video keep no trajectory: it is only asked
            what rewards and ends there were.
    """

    infix: Infix
    first_episode_id: int
    provenance: Mapping[str, Any] | None
    provenance_after: int
    clock: Callable[[], float]
    only_counted: bool = False


@dataclass(frozen=True)
class OpenDirectory:
    """A monitor directory with a claim in it.

    Attributes:
        path: the directory, absolute.
        infix: what the claim is for.
        first_episode_id: the number of the next episode.
        lock: held until the monitor closes.
        run: what is known of the run.
    """

    path: Path
    infix: Infix
    first_episode_id: int
    lock: Lock
    run: Mapping[str, Any]


def open_directory(
    directory: str | os.PathLike[str],
    *,
    force: bool,
    resume: bool | str,
    uid: str | None,
    env_info: Mapping[str, str],
    facts: Mapping[str, Any] = MappingProxyType({}),
    statements: Statements | None = None,
) -> OpenDirectory:
    """Claim a place in `directory`, which is made where it is missing.

    Args:
        directory: where to record.
        force: delete the monitor files that are there; wins over `resume`.
        resume: add to the recordings that are there. Episodes are numbered on from
            the highest number of the monitors with this `uid` that closed or died
            (without `uid`: of all of them); monitors that are still open do not count.
            `JOIN` looks at no other monitor's files, however many there are: the caller
            knows that they are of the same environment, and episodes are numbered
            from 0.
        uid: stands in the file names instead of the process id.
        env_info: `env_id` of the environment, among others.
        facts: what else is known of the run. It stands in the lock: so much is known of
            a process that was killed before its journal had a line.
        statements: of a run that is made again.

    Raises:
        ExistingRecordings: there are recordings, and neither `force` nor `resume`.
        DirectoryInUse: `force`, and another monitor is recording there.
        DifferentEnvironment: `resume` over recordings of another environment.
        DirectoryNotWritable: it cannot be made or written to.
        InvalidArgument: `uid` makes no file name.
    """
    wanted_uid = None if uid is None else check_uid(uid)
    # Absolute, so that a later chdir does not scatter the files.
    path = Path(directory).absolute()
    with made_directory(path):
        _check_existing(path, force=force, resume=resume, env_id=env_info["env_id"])
        joins = resume == JOIN and not force
        numbers_on = not (force or joins)
        if statements is not None:
            first = statements.first_episode_id
        else:
            first = _next_episode_id(path, uid=wanted_uid) if numbers_on else 0
        run = {"env_info": dict(env_info), **facts, "first_episode_id": first}
        if statements is not None:
            infix = statements.infix
            lock = Lock(path / lock_name(infix), json_text.dumps({"run": run}))
        else:
            infix, lock = _claim(path, uid=wanted_uid, run=run, looks=not joins)
    return OpenDirectory(path, infix, first, lock, run)


@contextlib.contextmanager
def made_directory(path: Path) -> Iterator[None]:
    """Make `path` and its parents; remove those made if the block raises.

    Raises:
        DirectoryNotWritable: it cannot be made or written to.
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
            # Other files may have come into it meanwhile.
            with contextlib.suppress(OSError):
                made.rmdir()
        raise


def _check_existing(
    path: Path, *, force: bool, resume: bool | str, env_id: str
) -> None:
    if force:
        clear_monitor_files(path)
        return
    if resume == JOIN:
        return
    existing = [file.name for file in iter_monitor_files(path, hidden=True)]
    if existing and not resume:
        raise ExistingRecordings(path, existing)
    for recorded in _recorded_env_ids(path):
        if recorded != env_id:
            raise DifferentEnvironment(path, recorded, env_id)


def _recorded_env_ids(path: Path) -> Iterator[str]:
    for files in monitors_of(path):
        env_info = MonitorResults(files).env_info or {}
        if isinstance(env_info.get("env_id"), str):
            yield env_info["env_id"]


def _next_episode_id(path: Path, *, uid: str | None) -> int:
    """Return the number after the highest of the monitors that are not open."""
    highest = -1
    for files in monitors_of(path):
        infix = Infix.parse(files.infix)
        if infix is None or (uid is not None and infix.uid != uid):
            continue
        if not is_locked(path / lock_name(infix)):
            highest = max(highest, _last_episode_id(files))
    return highest + 1


def _last_episode_id(files: MonitorFiles) -> int:
    """Return the highest episode number that a monitor's files speak of; -1 if none."""
    # Names count too: an episode in flight when a process died has a number.
    results = MonitorResults(files)
    return max(
        files.last_episode_id, results.run.last_episode_id, _last_counted(results)
    )


def _last_counted(results: MonitorResults) -> int:
    """Return the last number that the manifest says or implies."""
    if results.manifest is None:
        return -1
    if results.manifest.mjrec is not None:
        return int(results.manifest.mjrec.get("next_episode_id") or 0) - 1
    # Gym's own: its numbers count the resets, which have a type each, from 0.
    stats = results.saved
    if stats is None:
        return -1
    return max(len(stats.timestamps), len(stats.episode_types or ())) - 1


def _claim(
    path: Path, *, uid: str | None, run: Mapping[str, Any], looks: bool
) -> tuple[Infix, Lock]:
    """Return an infix that is this monitor's from now on, and its lock.

    Args:
        path: the directory.
        uid: stands in it instead of the process id; then its number follows from the
            directory, so that names are the same whichever process records.
        run: what is known of the run.
        looks: also for stray files with it. Without that, a manifest, a journal or a
            lock say that it was a monitor's: each monitor leaves one of them.
    """
    content = json_text.dumps({"pid": os.getpid(), "since": time.time(), "run": run})
    of_directory = itertools.count()
    while True:
        number = next(_monitor_ids if uid is None else of_directory)
        infix = Infix(number, uid or str(os.getpid()))
        if _is_taken(path, infix, looks=looks):
            continue
        try:
            lock = Lock(path / lock_name(infix), content)
        except FileExistsError:
            continue
        except OSError as error:
            raise DirectoryNotWritable(path, error.strerror) from error
        # The monitor that had it may have closed, and so unlocked, between the look
        # at the files and the lock.
        if not _is_taken(path, infix, besides=lock_name(infix), looks=looks):
            return infix, lock
        lock.release()


def _is_taken(
    path: Path, infix: Infix, *, looks: bool, besides: str | None = None
) -> bool:
    # The rare case is a pid or uid that was here before; the manifest, there after
    # every close, answers most of them without a look at the whole directory.
    if (path / manifest_name(infix)).exists() or (path / journal_name(infix)).exists():
        return True
    return looks and any(
        file.name != besides and infix_of(file.name) == str(infix)
        for file in iter_monitor_files(path, hidden=True)
    )

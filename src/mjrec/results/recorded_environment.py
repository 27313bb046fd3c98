# SPDX-License-Identifier: Apache-2.0
"""What a monitor recorded, also where it left no manifest to say it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import run_facts
from ..formats.json_fields import json_object, read_object
from ..formats.manifest import Manifest
from ..formats.spans import find_recording
from .monitor_files import MonitorFiles

# What stands for gym's version in what this package writes.
GYM_VERSION = "mjrec-1"

# A lock holds a line; this bounds what somebody may have put in its place.
_LONGEST_LOCK = 1 << 16

# Of many videos or trajectories, the first ones that can be read say it.
_TRIES = 3


def recorded_env_info(
    files: MonitorFiles, manifest: Manifest | None
) -> Mapping[str, Any] | None:
    """Return the `env_info` of a monitor; None where nothing says it.

    The manifest says it; without one the journal, the lock of a monitor that is open
    or was killed, a running trajectory, the metadata of a video: the first of them
    that can be read and does.

    Args:
        files: of the monitor.
        manifest: what its manifest says, where there is a sound one.
    """
    if manifest is not None:
        return manifest.env_info
    for path, read in _witnesses(files):
        try:
            env_info = read(path)
        except (OSError, ValueError, UnreadableFile):
            # Damaged, or gone just now; the next one may know.
            continue
        if isinstance(env_info, Mapping) and isinstance(env_info.get("env_id"), str):
            return env_info
    return None


def _witnesses(
    files: MonitorFiles,
) -> Iterator[tuple[Path, Callable[[Path], object]]]:
    if files.journal is not None:
        yield files.journal, _in_journal
    if files.lock is not None:
        yield files.lock, _in_lock
    paths = list(files.trajectories.values())
    yield from ((path, _in_log) for path in paths[:_TRIES] if not path.exists())
    yield from ((path, _in_metadata) for path in [*files.metadata.values()][:_TRIES])


def _in_journal(path: Path) -> object:
    return (run_facts(path) or {}).get("env_info")


def _in_lock(path: Path) -> object:
    return locked_run(path).get("env_info")


def locked_run(path: Path) -> Mapping[str, Any]:
    """Return what the lock of a monitor says of its run.

    Raises:
        OSError, ValueError: it cannot be read.
    """
    # Empty for a moment after it was made. A link is nobody's lock.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        run = json_object(os.read(descriptor, _LONGEST_LOCK)).get("run")
    finally:
        os.close(descriptor)
    return run if isinstance(run, Mapping) else {}


def _in_log(path: Path) -> object:
    recording = find_recording(path)
    return None if recording is None else _of(recording.facts.get("env_id"))


def _in_metadata(path: Path) -> object:
    return _of(read_object(path).get("env_id"))


def _of(env_id: object) -> Mapping[str, Any]:
    return {"gym_version": GYM_VERSION, "env_id": env_id}

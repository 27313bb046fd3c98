# SPDX-License-Identifier: Apache-2.0
"""Manifests of monitors that are closed, kept true while their videos come.

An open monitor writes its manifest itself, when it closes, after a look at what is
there; nobody else touches it until then. Afterwards it belongs to whoever has rendered
one of its pending videos. Should both happen at once, the manifest may still call a
video pending that is there: `reconcile` sees to that.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..errors import DirectoryNotWritable, UnreadableFile
from ..formats.locks import is_locked, wait_for_lock
from ..formats.manifest import Manifest, read_manifest, write_manifest
from ..formats.monitor_directory import (
    Infix,
    episode_of,
    infix_of,
    is_manifest,
    iter_monitor_files,
    lock_name,
    manifest_lock_name,
    manifest_name,
)
from ..formats.pending_videos import with_reason
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)


def reconcile(directory: Path) -> None:
    """Update the manifests of all monitors that are closed.

    Raises:
        UnreadableFile: one is damaged; the others are updated.
        DirectoryNotWritable: there can be no lock in the directory.
        FileNotWritten: the disk is full; manifests stay as they were.
    """
    damaged: UnreadableFile | None = None
    for path in iter_monitor_files(directory):
        infix = Infix.parse(infix_of(path.name) or "")
        if infix is not None and is_manifest(path.name):
            try:
                update_manifest(directory, infix)
            except UnreadableFile as error:
                damaged = damaged or error
    if damaged is not None:
        raise damaged


def update_manifest(
    directory: Path,
    infix: Infix,
    *,
    reasons: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Move what is there from the pending to the finished videos of a manifest.

    Nothing happens while the monitor is open, or where it left no manifest.

    Args:
        directory: the monitor directory.
        infix: the monitor's.
        reasons: why videos are still pending, by their base names: what became of the
            latest try.

    Raises:
        UnreadableFile: the manifest is damaged.
        DirectoryNotWritable: there can be no lock in the directory.
        FileNotWritten: the disk is full; the manifest stays as it was.
    """
    path = directory / manifest_name(infix)
    if not _has_news(path, infix, reasons):
        return
    try:
        lock = wait_for_lock(directory / manifest_lock_name(infix), f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error
    try:
        # Once more, because another process may have done it meanwhile.
        if _has_news(path, infix, reasons):
            write_manifest(path, _updated(read_manifest(path), directory, reasons))
    finally:
        lock.release()


def _has_news(path: Path, infix: Infix, reasons: Mapping[str, str]) -> bool:
    if not path.exists() or is_locked(path.with_name(lock_name(infix))):
        return False
    manifest = read_manifest(path)
    return _updated(manifest, path.parent, reasons) != manifest


def _updated(
    manifest: Manifest, directory: Path, reasons: Mapping[str, str]
) -> Manifest:
    if manifest.mjrec is None:
        return manifest
    pending = manifest.mjrec.get("pending") or []
    waiting: list[Any] = []
    broken = list(manifest.mjrec.get("broken") or [])
    videos = list(manifest.videos)
    for entry in pending:
        video = _video_of(entry, directory)
        if video is None:
            waiting.append(entry)
        elif not is_done(video):
            waiting.append(with_reason(entry, reasons))
        elif is_broken(metadata_path(video)):
            broken += [about for _, about in finished_videos(video)]
        else:
            videos += finished_videos(video)
    if waiting == list(pending):
        return manifest
    return replace(
        manifest,
        videos=tuple(sorted(videos, key=_episode_of_pair)),
        mjrec={**manifest.mjrec, "pending": waiting, "broken": broken},
    )


def _video_of(entry: Any, directory: Path) -> Path | None:
    """Return the video that a manifest calls pending; None for one elsewhere."""
    name = entry.get("video") if isinstance(entry, Mapping) else None
    if not isinstance(name, str) or episode_of(name) is None:
        return None
    return directory / name


def _episode_of_pair(names: tuple[str, str]) -> tuple[int, str]:
    return episode_of(names[0]) or 0, names[0]

# SPDX-License-Identifier: Apache-2.0
"""Functions that write statistics files and manifests from a monitor's other files.

In a monitor directory, only this module writes these files, only if their content
changes, and only at the following times:

- A monitor closes or, with `write_upon_reset`, begins an episode (`recorder.recorder`).
- A process has rendered pending videos (`rendering.finish`).
- A process has recovered a dead monitor's files (`rendering.recover_monitor`).
- An evaluation has chosen its videos (`rendering.chosen_videos`).

While a monitor is open, no other process writes its files.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.bundle import FINISHED
from ..formats.locks import Lock, is_locked, wait_for_lock
from ..formats.manifest import (
    GYM_VERSION,
    Manifest,
    StatsFile,
    read_manifest,
    write_manifest,
    write_stats_file,
)
from ..formats.monitor_directory import (
    clip_step,
    episode_of,
    infix_of,
    is_manifest,
    iter_monitor_files,
    journal_name,
    lock_name,
    manifest_lock_name,
    manifest_name,
    stats_prefix,
    tiled_name,
    trajectory_prefix,
    video_prefix,
    with_part,
)
from ..formats.spans import is_recorded
from ..formats.video_metadata import (
    finished_videos,
    forget_failure,
    is_broken,
    is_done,
    metadata_path,
    reason_of,
)
from .journal_or_stats import MonitorResults
from .monitor_files import MonitorFiles
from .run import Run

_FORMAT_VERSION = 1


@dataclass(frozen=True)
class Written:
    """The result of writing a manifest and statistics.

    Attributes:
        manifest: the current manifest.
        stats: the current statistics; None if they cannot be recovered.
        is_new_manifest: whether the manifest had to be written.
        is_new_stats: whether the statistics had to be written; always False for a
            monitor, because it passes its own statistics.
    """

    manifest: Manifest
    stats: StatsFile | None
    is_new_manifest: bool
    is_new_stats: bool

    @property
    def pending(self) -> list[Mapping[str, Any]]:
        """The videos that must still be rendered."""
        return list((self.manifest.mjrec or {}).get("pending", ()))


def update_manifests(directory: Path) -> None:
    """Update the manifests of closed monitors that list pending videos.

    Raises:
        UnreadableFile: a manifest is damaged. The other manifests are updated.
        DirectoryNotWritable: no lock can be created in the directory.
        FileNotWritten: the disk is full; existing manifests are unchanged.
    """
    damaged: UnreadableFile | None = None
    for path in iter_monitor_files(directory):
        infix = infix_of(path.name)
        if infix is not None and is_manifest(path.name):
            try:
                # Other manifests are up to date, and gym's manifests lack this key.
                if (read_manifest(path).mjrec or {}).get("pending"):
                    write_manifest_and_stats(directory, infix)
            except UnreadableFile as error:
                damaged = damaged or error
    if damaged is not None:
        raise damaged


def write_manifest_and_stats(
    directory: Path,
    infix: str,
    *,
    run: Run | None = None,
    stats: StatsFile | None = None,
    is_own: bool = False,
) -> Written | None:
    """Write the statistics and manifest of a monitor, if they are missing or outdated.

    Args:
        directory: the monitor directory.
        infix: the monitor's infix.
        run: the monitor's run; if None, it is read from the journal.
        stats: the monitor's statistics; if None, they are read from the journal or the
            statistics file, whichever has more episodes.
        is_own: whether the caller is the monitor or holds its lock. No other process
            changes the manifest of an open monitor.

    Returns:
        The current manifest and statistics, or None if the monitor is open.

    Raises:
        UnreadableFile: the journal or manifest is damaged, and nothing can replace it.
        DirectoryNotWritable: no lock can be created in the directory.
        FileNotWritten: the disk is full; existing files are unchanged.
    """
    name = f"{stats_prefix(infix)}.stats.json"
    if run is not None and stats is not None:
        # Write this file first: it reveals a full disk or a missing directory.
        write_stats_file(directory / name, stats)
    # While a monitor is open, no other process writes these files.
    with contextlib.nullcontext() if run else manifest_lock(directory, infix):
        if not is_own and is_locked(directory / lock_name(infix)):
            return None
        # Find files by name, because a folder may contain thousands of monitors' files.
        names = (manifest_name(infix), name, journal_name(infix))
        paths = [directory / each for each in names if (directory / each).exists()]
        results = MonitorResults(MonitorFiles(infix, paths))
        name = name if results.manifest is None else results.manifest.stats
        is_new_stats = False
        if stats is None:
            try:
                stats = results.stats()
            except UnreadableFile:
                # Accept missing statistics if there is no journal either.
                if results.files.journal is not None:
                    raise
            else:
                if stats is not results.saved:
                    is_new_stats = write_stats_file(directory / name, stats)
        manifest = _manifest(directory, infix, run or results.run, stats_name=name)
        is_new_manifest = write_manifest(directory / manifest_name(infix), manifest)
    return Written(manifest, stats, is_new_manifest, is_new_stats)


def manifest_lock(directory: Path, infix: str) -> Lock:
    """Wait for the lock to write a manifest or a closed monitor's journal.

    Raises:
        DirectoryNotWritable: no lock can be created in the directory.
    """
    return wait_for_lock(directory / manifest_lock_name(infix))


def _manifest(directory: Path, infix: str, run: Run, *, stats_name: str) -> Manifest:
    finished, broken = finished_and_broken(directory, infix, run)
    pending = _pending(directory, infix, run)
    keep, name, chosen = _keep(run), run.facts.get("schedule"), set(run.chosen)
    if keep is not None:
        name = f"keep:{keep.get('rule')}"
        # A killed process did not make its choice, so existing videos are candidates.
        names = [*(video for video, _ in finished), *broken]
        numbers = [*map(episode_of, names), *(e["episode_id"] for e in pending)]
        chosen.update(number for number in numbers if number is not None)
        chosen = set(keep.pop("recorded", chosen))
    details = {
        "format_version": _FORMAT_VERSION,
        "schedule": {"name": name, "recorded": sorted(chosen)},
        **({} if keep is None else {"keep": keep}),
        "first_episode_id": run.facts.get("first_episode_id", 0),
        "next_episode_id": run.last_episode_id + 1,
        "faults": run.faults,
        "versions": run.facts.get("versions", {}),
        "provenance": run.provenance,
        **({"recovered": True} if run.recovered else {}),
        "pending": pending,
        "broken": broken,
    }
    unknown = {"gym_version": GYM_VERSION, "env_id": None}
    return Manifest(
        stats=stats_name,
        videos=tuple(finished),
        env_info=run.facts.get("env_info") or unknown,
        mjrec=details,
    )


def _keep(run: Run) -> dict[str, Any] | None:
    """Return the facts about the choice of videos to keep, or None if all are kept."""
    if run.keep is not None:
        return dict(run.keep)
    if run.facts.get("keep") is None:
        return None
    return {
        "decided": False,
        "chosen": sorted(run.chosen),
        "finished": None,
        **run.facts["keep"],
    }


def finished_and_broken(
    directory: Path, infix: str, run: Run
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return finished videos with their metadata, and the metadata of broken videos.

    Videos from additional cameras exist once the first camera's video does, because its
    metadata is written last. A vector environment's tiled video exists independently.
    """
    names = {f"{video_prefix(infix, number)}.mp4" for number in run.filmed}
    finished: set[tuple[str, str]] = set()
    broken: set[str] = set()
    for first in (directory / name for name in names | set(run.clips)):
        views = {first.name, tiled_name(first.name)}
        if metadata_path(first).exists():
            views.update(with_part(first.name, v) for v in run.facts.get("views", ()))
            views.update(name for name, _ in finished_videos(first))
        for video in map(directory.joinpath, views):
            about, text = metadata_path(video), video.with_suffix(".json")
            if not about.exists():
                continue
            if is_broken(about):
                broken.add(about.name)
            elif video.exists() or text.exists():
                there = video if video.exists() else text
                finished.add((there.name, about.name))
    return sorted(finished), sorted(broken)


def _pending(directory: Path, infix: str, run: Run) -> list[Mapping[str, Any]]:
    """Return the manifest's entries for the videos that must still be rendered."""
    entries: list[Mapping[str, Any]] = [
        {
            "episode_id": number,
            "trajectory": trajectory_prefix(infix, number),
            "video": f"{video_prefix(infix, number)}.mp4",
        }
        for number in sorted(run.with_deferred_video)
    ]
    clips = [
        clip
        for clip in run.clips.values()
        if clip_step(str(clip.get("clip"))) is not None
    ]
    entries += [
        {key: clip[key] for key in ("episode_id", "clip", "video")}
        for clip in sorted(clips, key=lambda clip: str(clip["video"]))
    ]
    waiting: list[Mapping[str, Any]] = []
    for entry in entries:
        names = [entry["video"], *([entry["clip"]] if "clip" in entry else [])]
        if is_done(directory / entry["video"]):
            for name in names:
                forget_failure(directory / name)
        elif _is_recorded(directory, entry):
            reasons = filter(None, (reason_of(directory / name) for name in names))
            reason = next(reasons, None)
            waiting.append(entry if reason is None else {**entry, "reason": reason})
    return waiting


def _is_recorded(directory: Path, entry: Mapping[str, Any]) -> bool:
    path = directory / entry.get("clip", f"{entry.get('trajectory')}{FINISHED}")
    try:
        return is_recorded(path)
    except UnreadableFile:
        # The unreadable journal may list this recording.
        return True

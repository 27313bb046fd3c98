# SPDX-License-Identifier: Apache-2.0
"""Statistics file and manifest: what a monitor's journal and files amount to.

Both are written here and nowhere else: by the monitor, by a process that has rendered
some of its videos, by one that puts a dead monitor in order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.bundle import FINISHED, is_finished
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
    ClipPart,
    Infix,
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
from ..formats.spans import is_in_flight
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
    """What was written.

    Attributes:
        manifest: as it is now.
        stats: the statistics, as they are now; None where they cannot be had.
        is_new_manifest: it had to be written.
        is_new_stats: they were not there; a monitor writes its own in any case.
    """

    manifest: Manifest
    stats: StatsFile | None
    is_new_manifest: bool
    is_new_stats: bool

    @property
    def pending(self) -> list[Mapping[str, Any]]:
        """The videos that are still to be rendered."""
        return list((self.manifest.mjrec or {}).get("pending", ()))


def update_manifests(directory: Path) -> None:
    """Bring the manifests of closed monitors up to date that call videos pending.

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
                # Of the others nothing can be new; those of gym have no such key.
                if (read_manifest(path).mjrec or {}).get("pending"):
                    write_manifest_and_stats(directory, infix)
            except UnreadableFile as error:
                damaged = damaged or error
    if damaged is not None:
        raise damaged


def write_manifest_and_stats(
    directory: Path,
    infix: Infix,
    *,
    run: Run | None = None,
    stats: StatsFile | None = None,
    is_own: bool = False,
) -> Written | None:
    """Write statistics and manifest of a monitor, unless they are there already.

    Args:
        directory: the monitor directory.
        infix: the monitor's.
        run: what is known of its run; its journal is read if None.
        stats: its statistics; if None, those of the journal or of the statistics file,
            whichever has more episodes.
        is_own: the caller is the monitor, or holds its lock. No other process touches
        the
            manifest of a monitor that is open.

    Returns:
        What is there now; None where the monitor is open.

    Raises:
        UnreadableFile: journal or manifest are damaged, and nothing stands in for them.
        DirectoryNotWritable: there can be no lock in the directory.
        FileNotWritten: the disk is full; what was there before still is.
    """
    name = f"{stats_prefix(infix)}.stats.json"
    if run is not None and stats is not None:
        # First of all: it tells a directory that is full, or gone.
        write_stats_file(directory / name, stats)
    # No other process writes beside an open monitor.
    with contextlib.nullcontext() if run else manifest_lock(directory, infix):
        if not is_own and is_locked(directory / lock_name(infix)):
            return None
        # By their names: a folder may hold the files of thousands of monitors.
        names = (manifest_name(infix), name, journal_name(infix))
        paths = [directory / each for each in names if (directory / each).exists()]
        results = MonitorResults(MonitorFiles(str(infix), paths))
        name = name if results.manifest is None else results.manifest.stats
        is_new_stats = False
        if stats is None:
            try:
                stats = results.stats()
            except UnreadableFile:
                # They may be gone, and no journal be there.
                if results.files.journal is not None:
                    raise
            else:
                if stats is not results.saved:
                    is_new_stats = write_stats_file(directory / name, stats)
        manifest = _manifest(directory, infix, run or results.run, stats_name=name)
        is_new_manifest = write_manifest(directory / manifest_name(infix), manifest)
    return Written(manifest, stats, is_new_manifest, is_new_stats)


def manifest_lock(directory: Path, infix: Infix) -> Lock:
    """Return the lock for writing a manifest, or a journal once its monitor is closed.

    Raises:
        DirectoryNotWritable: there can be no lock in the directory.
    """
    return wait_for_lock(directory / manifest_lock_name(infix))


def _manifest(directory: Path, infix: Infix, run: Run, *, stats_name: str) -> Manifest:
    finished, broken = finished_and_broken(directory, infix, run)
    pending = _pending(directory, infix, run)
    keep, name, chosen = _keep(run), run.facts.get("schedule"), set(run.chosen)
    if keep is not None:
        name = f"keep:{keep.get('rule')}"
        # A process that was killed had not chosen: what is there are candidates.
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
    """Return what is said of the videos that are kept; None where all are."""
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
    directory: Path, infix: Infix | str, run: Run
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return finished videos, each with its metadata, and the metadata of broken ones.

    A video of further cameras is there once its first video is, whose metadata comes
    last of all. The tiled one of a vector environment is there by itself.
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


def _pending(directory: Path, infix: Infix, run: Run) -> list[Mapping[str, Any]]:
    """Return how a manifest names the videos that are still to be rendered."""
    entries: list[Mapping[str, Any]] = [
        {
            "episode_id": number,
            "trajectory": trajectory_prefix(infix, number),
            "video": f"{video_prefix(infix, number)}.mp4",
        }
        for number in sorted(run.promised)
    ]
    clips = [
        clip for clip in run.clips.values() if ClipPart.parse(str(clip.get("clip")))
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
        return is_finished(path) or is_in_flight(path)
    except UnreadableFile:
        # It may be in the list that cannot be read.
        return True

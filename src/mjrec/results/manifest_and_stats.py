# SPDX-License-Identifier: Apache-2.0
"""Statistics file and manifest: what a monitor's journal and files amount to.

Both are written here and nowhere else: by the monitor, by a process that has rendered
some of its videos, by one that puts a dead monitor in order.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import json_text
from ..errors import DirectoryNotWritable, UnreadableFile
from ..formats.locks import is_locked, wait_for_lock
from ..formats.manifest import Manifest, read_manifest, write_manifest
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
    trajectory_prefix,
    video_prefix,
)
from ..formats.render_failures import forget_failure, reason_of
from ..formats.spans import FINISHED, is_in_flight
from ..formats.stats_file import StatsFile, read_stats_file, write_stats_file
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)
from ..formats.video_names import tiled_name, with_part
from .journal_or_stats import MonitorResults
from .monitor_files import MonitorFiles
from .recorded_environment import GYM_VERSION
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
        is_own: the caller is the monitor, or holds its lock. Nobody else touches the
            manifest of a monitor that is open.

    Returns:
        What is there now; None where the monitor is open.

    Raises:
        UnreadableFile: journal or manifest are damaged, and nothing stands in for them.
        DirectoryNotWritable: there can be no lock in the directory.
        FileNotWritten: the disk is full; what was there before still is.
    """
    has_written = run is not None and stats is not None
    if has_written and stats is not None:
        # First of all: it tells a directory that is full, or gone.
        write_stats_file(directory / f"{stats_prefix(infix)}.stats.json", stats)
    # A monitor that is open has nobody beside it.
    with contextlib.nullcontext() if run else manifest_lock(directory, infix):
        if not is_own and is_locked(directory / lock_name(infix)):
            return None
        files = _files_of(directory, infix)
        results = MonitorResults(files)
        old = results.manifest
        if run is None:
            run = Run() if files.journal is None else Run.read(files.journal)
        stats = _stats_of(results) if stats is None else stats
        name = f"{stats_prefix(infix)}.stats.json" if old is None else old.stats
        is_new_stats = False
        if stats is not None and not has_written:
            is_new_stats = _saved(directory / name) != stats
            if is_new_stats:
                write_stats_file(directory / name, stats)
        manifest = _manifest(directory, infix, results, run, stats_name=name)
        is_new = old is None or _as_read(manifest) != old
        if is_new:
            write_manifest(directory / manifest_name(infix), manifest)
        _forget_failures(directory, results.details, manifest)
    return Written(manifest, stats, is_new, is_new_stats)


@contextlib.contextmanager
def manifest_lock(directory: Path, infix: Infix) -> Iterator[None]:
    """Hold the lock for writing a monitor's manifest, or its journal once it is closed.

    Raises:
        DirectoryNotWritable: there can be no lock in the directory.
    """
    try:
        lock = wait_for_lock(directory / manifest_lock_name(infix), f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error
    try:
        yield
    finally:
        lock.release()


def _files_of(directory: Path, infix: Infix) -> MonitorFiles:
    """Return what results are read from.

    By their names: a folder may hold the files of thousands of monitors.
    """
    names = (manifest_name(infix), f"{stats_prefix(infix)}.stats.json")
    paths = [directory / name for name in (*names, journal_name(infix))]
    return MonitorFiles(str(infix), [path for path in paths if path.exists()])


def _stats_of(results: MonitorResults) -> StatsFile | None:
    """Return the statistics; None where they are gone, and the journal too."""
    try:
        return results.stats()
    except UnreadableFile:
        if results.files.journal is not None:
            raise
        return None


def _saved(path: Path) -> StatsFile | None:
    try:
        return read_stats_file(path)
    except UnreadableFile:
        return None


def _as_read(manifest: Manifest) -> Manifest:
    """Return a manifest as it comes back from a file: tuples are lists there."""
    return replace(manifest, mjrec=json_text.loads(json_text.dumps(manifest.mjrec)))


def _manifest(
    directory: Path, infix: Infix, results: MonitorResults, run: Run, *, stats_name: str
) -> Manifest:
    """Return the manifest; what the journal lost, the old one may still say."""
    old = results.details
    finished, broken = _videos(_first_videos(directory, infix, run, results), run)
    pending = _pending(directory, infix, run, old)
    if run.facts or not old:
        names = [*(video for video, _ in finished), *broken]
        details = _details(run, old, pending, names)
    else:
        details = {**old}
    return Manifest(
        stats=stats_name,
        videos=tuple(finished),
        env_info=run.facts.get("env_info")
        or results.env_info
        or {"gym_version": GYM_VERSION, "env_id": None},
        mjrec={**details, "pending": pending, "broken": broken},
    )


def _details(
    run: Run,
    old: Mapping[str, Any],
    pending: Sequence[Mapping[str, Any]],
    names: Sequence[str],
) -> dict[str, Any]:
    """Return what gym's manifests do not say, but for the videos.

    Args:
        run: as its journal tells it.
        old: what the manifest that is there says.
        pending: the videos that are pending.
        names: of those that are there, or broken.
    """
    keep = _keep(run)
    name = run.facts.get("schedule")
    chosen = set(run.chosen)
    if keep is not None:
        name = f"keep:{keep.get('rule')}"
        # A process that was killed had not chosen: what is there are candidates.
        numbers = [*map(episode_of, names), *(e.get("episode_id") for e in pending)]
        chosen.update(number for number in numbers if number is not None)
        chosen = set(keep.pop("recorded", chosen))
    faults = [fault for fault in old.get("faults") or () if fault not in run.faults]
    return {
        "format_version": _FORMAT_VERSION,
        "schedule": {"name": name, "recorded": sorted(chosen)},
        **({} if keep is None else {"keep": keep}),
        "first_episode_id": run.facts.get("first_episode_id", 0),
        "next_episode_id": max(
            run.last_episode_id + 1, old.get("next_episode_id") or 0
        ),
        "faults": [*faults, *run.faults],
        "versions": run.facts.get("versions", {}),
        "surroundings": run.surroundings or old.get("surroundings"),
        **({"recovered": True} if run.recovered else {}),
    }


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
        "most_bytes_held": None,
        **run.facts["keep"],
    }


def _first_videos(
    directory: Path, infix: Infix, run: Run, results: MonitorResults
) -> list[Path]:
    """Return the videos that there may be, in order, but for further cameras'."""
    names = {f"{video_prefix(infix, number)}.mp4" for number in run.filmed}
    names.update(run.clips)
    if not run.facts and results.manifest is not None:
        # The journal is gone, or its beginning.
        manifest, old = results.manifest, results.details
        names.update(video for video, _ in manifest.videos)
        names.update(f"{_stem(about)}.mp4" for about in old.get("broken") or ())
        pending = filter(_names_video, old.get("pending") or ())
        names.update(entry["video"] for entry in pending)
    return [directory / name for name in sorted(names)]


def _videos(
    firsts: Iterable[Path], run: Run
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return finished videos, each with its metadata, and the metadata of broken ones.

    A video of further cameras is there once its first video is, whose metadata comes
    last of all. The tiled one of a vector environment is there by itself.
    """
    finished: dict[tuple[str, str], None] = {}
    broken: dict[str, None] = {}
    for first in firsts:
        views = [first, first.with_name(tiled_name(first.name))]
        if metadata_path(first).exists():
            names = (with_part(first.name, view) for view in run.facts.get("views", ()))
            views += map(first.with_name, names)
            views += (first.with_name(name) for name, _ in finished_videos(first))
        for video in views:
            about = metadata_path(video)
            text = video.with_suffix(".json")
            if not about.exists():
                continue
            if is_broken(about):
                broken[about.name] = None
            elif video.exists() or text.exists():
                there = video if video.exists() else text
                finished[there.name, about.name] = None
    return sorted(finished), sorted(broken)


def _pending(
    directory: Path, infix: Infix, run: Run, old: Mapping[str, Any]
) -> list[Mapping[str, Any]]:
    """Return how a manifest names the videos that are still to be rendered."""
    keep = run.keep or {}
    is_final = keep.get("decided") is True
    wanted = set(keep.get("recorded", ())) if is_final else run.deferred - run.dropped
    entries: list[Mapping[str, Any]] = [
        {
            "episode_id": number,
            "trajectory": trajectory_prefix(infix, number),
            "video": f"{video_prefix(infix, number)}.mp4",
        }
        for number in sorted(wanted & run.deferred)
        if _is_recorded(directory / f"{trajectory_prefix(infix, number)}{FINISHED}")
    ]
    clips = [
        {key: clip[key] for key in ("episode_id", "clip", "video")}
        for clip in run.clips.values()
        if ClipPart.parse(str(clip.get("clip"))) is not None
        and _is_recorded(directory / str(clip["clip"]))
    ]
    entries += sorted(clips, key=lambda clip: str(clip["video"]))
    if not run.facts:
        # The journal is gone, or its beginning.
        entries += [e for e in old.get("pending") or () if e not in entries]
    return [
        _with_reason(directory, entry)
        for entry in entries
        if not _names_video(entry) or not is_done(directory / entry["video"])
    ]


def _is_recorded(path: Path) -> bool:
    try:
        return path.is_file() or is_in_flight(path)
    except UnreadableFile:
        # It may be in the list that cannot be read.
        return True


def _names_video(entry: Mapping[str, Any]) -> bool:
    """Tell whether an entry names a video of this directory; it may be anybody's."""
    name = entry.get("video")
    return isinstance(name, str) and episode_of(name) is not None


def _with_reason(directory: Path, entry: Mapping[str, Any]) -> Mapping[str, Any]:
    if not _names_video(entry):
        return entry
    reason = reason_of(directory / entry["video"])
    clip = str(entry.get("clip"))
    if reason is None and ClipPart.parse(clip) is not None:
        reason = reason_of(directory / clip)
    said = {key: value for key, value in entry.items() if key != "reason"}
    return said if reason is None else {**said, "reason": reason}


def _forget_failures(
    directory: Path, old: Mapping[str, Any], manifest: Manifest
) -> None:
    """Remove what was said of videos that are not pending any more."""
    pending = (manifest.mjrec or {})["pending"]
    waiting = {entry["video"] for entry in filter(_names_video, pending)}
    for entry in filter(_names_video, old.get("pending") or ()):
        if entry["video"] not in waiting:
            forget_failure(directory / entry["video"])
            if ClipPart.parse(str(entry.get("clip"))) is not None:
                forget_failure(directory / str(entry["clip"]))


def _stem(metadata: str) -> str:
    return metadata.removesuffix(".meta.json")

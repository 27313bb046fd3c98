# SPDX-License-Identifier: Apache-2.0
"""Statistics file and manifest: what a monitor's journal and files amount to.

Both are written here and nowhere else: by the monitor, by a process that has rendered
some of its videos, by one that puts a dead monitor in order.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import json_text
from ..errors import DirectoryNotWritable, UnreadableFile
from ..formats.in_flight import recordings_in_flight
from ..formats.json_fields import read_object
from ..formats.locks import is_locked, wait_for_lock
from ..formats.manifest import Manifest, read_manifest, write_manifest
from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    episode_of,
    infix_of,
    is_manifest,
    iter_monitor_files,
    lock_name,
    manifest_lock_name,
    manifest_name,
    stats_prefix,
    trajectory_prefix,
    video_prefix,
)
from ..formats.pending_videos import failure_path, reason_of
from ..formats.stats_file import StatsFile, read_stats_file, write_stats_file
from ..formats.video_metadata import is_done, metadata_path
from ..formats.video_names import tiled_name
from .monitor_files import MonitorFiles
from .recorded_environment import GYM_VERSION
from .run import Run
from .sources import MonitorResults

_FORMAT_VERSION = 1
_FIRST_METADATA = re.compile(r"(?P<video>.*\.video\d{6,18}(\.step\d+)?)\.meta\.json")


@dataclass(frozen=True)
class Listing:
    """What was written.

    Attributes:
        manifest: as it is now.
        stats: the statistics, as they are now; None where they cannot be had.
        is_new_manifest: it had to be written.
        is_new_stats: they had to be written.
    """

    manifest: Manifest
    stats: StatsFile | None
    is_new_manifest: bool
    is_new_stats: bool

    @property
    def pending(self) -> list[Mapping[str, Any]]:
        """The videos that are still to be rendered."""
        return list((self.manifest.mjrec or {}).get("pending", ()))


def write_listings(directory: Path) -> None:
    """Bring the manifests of all monitors that are closed up to date.

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
                # One that says nothing of us is gym's own.
                if read_manifest(path).mjrec is not None:
                    write_listing(directory, infix)
            except UnreadableFile as error:
                damaged = damaged or error
    if damaged is not None:
        raise damaged


def write_listing(
    directory: Path,
    infix: Infix,
    *,
    run: Run | None = None,
    stats: StatsFile | None = None,
    is_own: bool = False,
) -> Listing | None:
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
    if run is not None and stats is not None:
        # First of all: it tells a directory that is full, or gone.
        write_stats_file(directory / f"{stats_prefix(infix)}.stats.json", stats)
    # A monitor that is open has nobody beside it.
    with contextlib.nullcontext() if run else listing_lock(directory, infix):
        if not is_own and is_locked(directory / lock_name(infix)):
            return None
        files = _files_of(directory, infix)
        results = MonitorResults(files)
        old = results.manifest
        if run is None:
            run = Run() if files.journal is None else Run.read(files.journal)
        stats = _stats_of(results) if stats is None else stats
        name = f"{stats_prefix(infix)}.stats.json" if old is None else old.stats
        is_new_stats = stats is not None and _saved(directory / name) != stats
        if stats is not None and is_new_stats:
            write_stats_file(directory / name, stats)
        manifest = _manifest(directory, infix, files, results, run, stats_name=name)
        is_new = old is None or _as_read(manifest) != old
        if is_new:
            write_manifest(directory / manifest_name(infix), manifest)
        _forget_failures(directory, files, manifest)
    return Listing(manifest, stats, is_new, is_new_stats)


@contextlib.contextmanager
def listing_lock(directory: Path, infix: Infix) -> Iterator[None]:
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
    own = f".{infix}."
    with os.scandir(directory) as entries:
        names = [e.name for e in entries if own in e.name]
    paths = (directory / n for n in names if infix_of(n) == str(infix))
    in_flight = (each.path for each in recordings_in_flight(directory, infix))
    return MonitorFiles(str(infix), (*paths, *in_flight))


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
    directory: Path,
    infix: Infix,
    files: MonitorFiles,
    results: MonitorResults,
    run: Run,
    *,
    stats_name: str,
) -> Manifest:
    """Return the manifest; what the journal lost, the old one may still say."""
    old = results.details
    finished, broken = _videos(directory, files)
    pending = _pending(directory, infix, files, run, old)
    if run.facts or not old:
        names = [*(video for video, _ in finished), *broken]
        details = _details(run, files, old, pending, names)
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
    files: MonitorFiles,
    old: Mapping[str, Any],
    pending: Sequence[Mapping[str, Any]],
    names: Sequence[str],
) -> dict[str, Any]:
    """Return what gym's manifests do not say, but for the videos.

    Args:
        run: as its journal tells it.
        files: of the monitor.
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
    following = max(run.last_episode_id, files.last_episode_id) + 1
    faults = [fault for fault in old.get("faults") or () if fault not in run.faults]
    return {
        "format_version": _FORMAT_VERSION,
        "schedule": {"name": name, "recorded": sorted(chosen)},
        **({} if keep is None else {"keep": keep}),
        "first_episode_id": run.facts.get("first_episode_id", 0),
        "next_episode_id": max(following, old.get("next_episode_id") or 0),
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


def _videos(
    directory: Path, files: MonitorFiles
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return finished videos, each with its metadata, and the metadata of broken ones.

    A further camera's names its first video, whose metadata comes last of all. One that
    was rendered another way names none, and is nobody's but its maker's.
    """
    finished: list[tuple[str, str]] = []
    broken: list[str] = []
    names = {path.name for path in files.all_metadata}
    for path in files.all_metadata:
        try:
            said = read_object(path)
        except (OSError, ValueError):
            said = {}
        video = _video_of(path, said, names)
        if video is None:
            continue
        if said.get("broken"):
            broken.append(path.name)
        elif video.exists():
            finished.append((video.name, path.name))
    return finished, broken


def _video_of(metadata: Path, said: Mapping[str, Any], names: set[str]) -> Path | None:
    """Return the video that a manifest lists with its metadata; None for others."""
    stem = metadata.name.removesuffix(".meta.json")
    video = metadata.with_name(f"{stem}.mp4")
    if _FIRST_METADATA.fullmatch(metadata.name):
        text = video.with_suffix(".json")
        return text if not video.exists() and text.exists() else video
    first = said.get("first_video")
    if isinstance(first, str) and metadata_path(Path(first)).name in names:
        return video
    number = episode_of(metadata.name)
    prefix = stem.rpartition(".")[0]
    is_tiled = number is not None and video.name == tiled_name(f"{prefix}.mp4")
    return video if is_tiled and said.get("tiled") else None


def _pending(
    directory: Path, infix: Infix, files: MonitorFiles, run: Run, old: Mapping[str, Any]
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
        if number in files.trajectories
    ]
    clips = [
        {key: clip[key] for key in ("episode_id", "clip", "video")}
        for clip in run.clips.values()
        if clip.get("clip") in files.clip_parts
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


def _forget_failures(directory: Path, files: MonitorFiles, manifest: Manifest) -> None:
    """Remove what was said of videos that are not pending any more."""
    pending = (manifest.mjrec or {}).get("pending") or ()
    said = {
        failure_path(directory / str(entry[key])).name
        for entry in pending
        for key in ("video", "clip")
        if key in entry and _names_video(entry)
    }
    for path in files.failures:
        if path.name not in said:
            path.unlink(missing_ok=True)

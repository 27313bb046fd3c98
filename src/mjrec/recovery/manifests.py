# SPDX-License-Identifier: Apache-2.0
"""Statistics and manifest of a dead monitor, made of what else it left."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from .. import json_text
from ..errors import DirectoryNotWritable, UnreadableFile
from ..formats.journal import JournalEntry, JournalWriter, entry_of
from ..formats.json_fields import (
    read_object,
    unreadable,
)
from ..formats.locks import wait_for_lock
from ..formats.manifest import Manifest, read_manifest, write_manifest
from ..formats.monitor_directory import (
    Infix,
    episode_of,
    journal_name,
    manifest_lock_name,
    manifest_name,
    stats_prefix,
    trajectory_prefix,
    video_prefix,
)
from ..formats.pending_videos import pending_video
from ..formats.stats_file import StatsFile, read_stats_file, write_stats_file
from ..formats.video_metadata import (
    finished_videos,
    is_broken,
    is_done,
    metadata_path,
)
from ..formats.video_names import tiled_name
from ..results.recorded_environment import GYM_VERSION
from ..results.sources import MonitorResults
from .clips import pending_clips, videos_begun_by_steps
from .known_episodes import KnownEpisodes
from .remains import Remains, look_through
from .report import RecoveredFile
from .selections import choice_of

_FORMAT_VERSION = 1


def write_results(
    directory: Path, infix: Infix, known: KnownEpisodes
) -> Iterator[RecoveredFile]:
    """Bring journal, statistics and manifest of a dead monitor up to date.

    The journal gets the episodes that it lacks and whose trajectories say that they
    were complete. The statistics are those of the journal, or of the statistics file
    that is there, whichever has more episodes. Nothing is written that is there.

    Yields:
        What was written.

    Raises:
        UnreadableFile: journal or manifest are damaged and nothing stands in for them.
        DirectoryNotWritable: there can be no lock in the directory.
        FileNotWritten: the disk is full.
    """
    remains = look_through(directory, infix)
    if not _has_anything(remains):
        return
    try:
        lock = wait_for_lock(directory / manifest_lock_name(infix), f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error
    try:
        added = _complete_journal(remains, known)
        if added:
            what = f"{added} {'episode' if added == 1 else 'episodes'} added"
            yield RecoveredFile(journal_name(infix), what)
        yield from _write(look_through(directory, infix), known)
    finally:
        lock.release()


def _has_anything(remains: Remains) -> bool:
    files = remains.files
    return any(
        (
            *(files.journal, files.manifest, files.stats),
            *(files.trajectories, files.videos, files.metadata),
            remains.clip_parts,
        )
    )


def _complete_journal(remains: Remains, known: KnownEpisodes) -> int:
    """Add the complete episodes that the journal lacks; return how many they are."""
    missing = [
        entry
        for episode_id in sorted(remains.files.trajectories)
        if known.entry(episode_id) is None
        and (entry := _entry_of(remains, known, episode_id)) is not None
    ]
    if not missing:
        return 0
    path = remains.directory / journal_name(remains.infix)
    _end_last_line(path)
    writer = JournalWriter(
        path, env_info=None if path.exists() else _env_info(remains, known)
    )
    try:
        for entry in missing:
            writer.append(entry)
    finally:
        writer.close()
    return len(missing)


def _entry_of(
    remains: Remains, known: KnownEpisodes, episode_id: int
) -> JournalEntry | None:
    """Return the journal's line of an episode that its trajectory calls complete."""
    try:
        facts = known.facts(episode_id)
        if facts.get("complete") is not True:
            return None
        with unreadable(remains.files.trajectories[episode_id]):
            return entry_of({**facts, "episode_id": episode_id})
    except UnreadableFile:
        return None


def _end_last_line(journal: Path) -> None:
    """End a last line that was cut off, so that it does not damage the next one."""
    if not journal.exists():
        return
    with journal.open("r+b") as file:
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")


def _write(remains: Remains, known: KnownEpisodes) -> Iterator[RecoveredFile]:
    results = MonitorResults(remains.files)
    stats = results.stats()
    old = results.manifest
    name = f"{stats_prefix(remains.infix)}.stats.json" if old is None else old.stats
    if _saved(remains.directory / name) != stats:
        write_stats_file(remains.directory / name, stats)
        count = len(stats.timestamps)
        yield RecoveredFile(name, f"{count} {'episode' if count == 1 else 'episodes'}")
    manifest = _manifest(remains, known, old, stats_name=name)
    path = remains.directory / manifest_name(remains.infix)
    if not _is_there(path, manifest):
        write_manifest(path, manifest)
        pending = len((manifest.mjrec or {}).get("pending", ()))
        rest = f", {pending} pending: mjrec render" if pending else ""
        yield RecoveredFile(path.name, _count_videos(manifest) + rest)


def _saved(path: Path) -> StatsFile | None:
    try:
        return read_stats_file(path)
    except UnreadableFile:
        return None


def _is_there(path: Path, manifest: Manifest) -> bool:
    if not path.exists():
        return False
    try:
        found = read_manifest(path)
    except UnreadableFile:
        return False
    # As they are in a file: tuples are lists there.
    mjrec = json_text.loads(json_text.dumps(manifest.mjrec))
    return found == replace(manifest, mjrec=mjrec)


def _manifest(
    remains: Remains,
    known: KnownEpisodes,
    old: Manifest | None,
    *,
    stats_name: str,
) -> Manifest:
    files = remains.files
    old_details = {} if old is None or old.mjrec is None else dict(old.mjrec)
    finished: list[tuple[str, str]] = []
    broken: list[str] = []
    for episode_id in sorted({*files.videos, *files.metadata}):
        names = _names_of_video(remains, episode_id)
        if names is not None and is_broken(remains.directory / names[1]):
            broken += [about for _, about in _all_videos(remains, names)]
        elif names is not None and (remains.directory / names[0]).exists():
            finished += _all_videos(remains, names)
    for video in videos_begun_by_steps(remains):
        if is_broken(metadata_path(video)):
            broken += [about for _, about in finished_videos(video)]
        elif video.exists():
            finished += finished_videos(video)
    finished += [names for names in _tiled_videos(remains) if names not in finished]
    first = known.first_episode_id or 0
    pending = [
        _as_listed(entry, old_details)
        for entry in (
            *(
                _pending(remains, episode_id)
                for episode_id in sorted(files.trajectories)
                if _is_pending(remains, known, episode_id)
            ),
            *pending_clips(remains),
        )
    ]
    choice = choice_of(remains, known, old_details)
    return Manifest(
        stats=stats_name,
        videos=tuple(finished),
        env_info=_env_info(remains, known),
        mjrec={
            "format_version": _FORMAT_VERSION,
            "schedule": _schedule(remains, known, old_details, choice),
            **({} if choice is None else {"keep": choice}),
            "first_episode_id": old_details.get("first_episode_id", first),
            "next_episode_id": known.last_episode_id + 1,
            "pending": pending,
            "broken": broken,
            "faults": old_details.get("faults", []),
            "versions": old_details.get("versions") or _versions(remains, known),
            **{k: old_details[k] for k in ("surroundings",) if k in old_details},
            "recovered": True,
        },
    )


def _names_of_video(remains: Remains, episode_id: int) -> tuple[str, str] | None:
    """Return the names of a video, whichever kind it is, and of its metadata."""
    prefix = video_prefix(remains.infix, episode_id)
    metadata = f"{prefix}.meta.json"
    if not (remains.directory / metadata).exists():
        return None
    for extension in (".mp4", ".json"):
        if (remains.directory / f"{prefix}{extension}").exists():
            return f"{prefix}{extension}", metadata
    return f"{prefix}.mp4", metadata


def _all_videos(remains: Remains, first: tuple[str, str]) -> list[tuple[str, str]]:
    """Return the names of an episode's first video and of its further cameras'."""
    return finished_videos(remains.directory / first[0])


def _tiled_videos(remains: Remains) -> list[tuple[str, str]]:
    """Return the names of finished videos of all sub-environments, each a pair.

    They belong to no first video: that one may have been rendered later, or never.
    """
    return [
        (path.name, metadata_path(path).name)
        for path in remains.paths
        if (number := episode_of(path.name)) is not None
        and path.name == tiled_name(f"{video_prefix(remains.infix, number)}.mp4")
        and metadata_path(path).exists()
        and not is_broken(metadata_path(path))
    ]


def _pending(remains: Remains, episode_id: int) -> dict[str, Any]:
    """Return how a manifest names a pending video."""
    return pending_video(
        episode_id,
        trajectory=trajectory_prefix(remains.infix, episode_id),
        video=f"{video_prefix(remains.infix, episode_id)}.mp4",
    )


def _as_listed(
    entry: dict[str, Any], old_details: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return an entry of what is pending; as it was, if it was listed before."""
    listed = old_details.get("pending")
    for old in listed if isinstance(listed, list) else ():
        # It may say more, of a try that has failed.
        if isinstance(old, Mapping) and entry.items() <= old.items():
            return old
    return entry


def _is_pending(remains: Remains, known: KnownEpisodes, episode_id: int) -> bool:
    video = remains.directory / f"{video_prefix(remains.infix, episode_id)}.mp4"
    if is_done(video):
        return False
    try:
        recorded = known.facts(episode_id).get("video") or {}
    except UnreadableFile:
        return False
    return recorded.get("recording") == "deferred"


def _schedule(
    remains: Remains,
    known: KnownEpisodes,
    old_details: Mapping[str, Any],
    choice: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return what can still be told of the schedule: its name only by a manifest."""
    files = remains.files
    said = old_details.get("schedule")
    old = said if isinstance(said, Mapping) else {}
    listed = old.get("recorded")
    recorded = {
        *files.videos,
        *files.metadata,
        *(listed if isinstance(listed, list) else ()),
    }
    recorded |= {
        clip["episode_id"] for clip in pending_clips(remains) if _is_scheduled(clip)
    }
    for episode_id in files.trajectories:
        if episode_id not in recorded:
            try:
                if known.facts(episode_id).get("video"):
                    recorded.add(episode_id)
            except UnreadableFile:
                continue
    rule = None if choice is None else f"keep:{choice['rule']}"
    return {"name": old.get("name") or rule, "recorded": sorted(recorded)}


def _is_scheduled(clip: Mapping[str, Any]) -> bool:
    """Tell whether a clip began with its episode, and is called as that."""
    return bool(clip["video"].endswith(f".video{clip['episode_id']:06d}.mp4"))


def _env_info(remains: Remains, known: KnownEpisodes) -> Mapping[str, Any]:
    if known.env_info is not None:
        return known.env_info
    # Gym's reader demands both keys.
    return {"gym_version": GYM_VERSION, "env_id": _first(remains, known, "env_id")}


def _versions(remains: Remains, known: KnownEpisodes) -> Any:
    return _first(remains, known, "versions") or {}


def _first(remains: Remains, known: KnownEpisodes, key: str) -> Any:
    """Return what the first file that says it says of an episode."""
    files = remains.files
    for episode_id in files.trajectories:
        try:
            said = known.facts(episode_id).get(key)
        except UnreadableFile:
            continue
        if said:
            return said
    for metadata in files.metadata.values():
        try:
            said = read_object(metadata).get(key)
        except (OSError, ValueError):
            continue
        if said:
            return said
    return None


def _count_videos(manifest: Manifest) -> str:
    count = len(manifest.videos)
    return f"{count} {'video' if count == 1 else 'videos'}"

# SPDX-License-Identifier: Apache-2.0
"""What one monitor's files say, read once for all that is checked of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import UnreadableFile
from ...formats.journal import JournalEntry, JournalReader
from ...formats.json_fields import read_object
from ...formats.manifest import Manifest, StatsFile, read_manifest, read_stats_file
from ...formats.monitor_directory import episode_of, view_of
from ...formats.video_metadata import metadata_path
from ...results.monitor_files import MonitorFiles, monitors_of
from ...results.run import Run

# Of each, some hundred bytes are in memory.
_MOST_EPISODES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class RecordedVideo:
    """A video, or what is left of one.

    Attributes:
        name: of the file, be it there or not.
        episode_id: by its name.
        is_main: it is the first of its episode, as far as its name says.
        is_there: the file is.
        metadata: what is said about it; nothing where that cannot be read.
    """

    name: str
    episode_id: int
    is_main: bool
    is_there: bool
    metadata: Mapping[str, Any]

    @property
    def is_broken(self) -> bool:
        """Whether it is said to have been given up."""
        return self.metadata.get("broken") is True

    @property
    def is_clip(self) -> bool:
        """Whether it is counted in steps, and may go on across episodes."""
        return "first_step" in self.metadata


@dataclass(frozen=True, kw_only=True)
class RecordedMonitor:
    """What one monitor's files say.

    Attributes:
        infix: in the names of its files.
        files: its files.
        manifest: None where there is none, or `reasons` says why it cannot be read.
        stats: the statistics file, likewise.
        entries: of the journal; None where there is none that can be read.
        dropped: how many lines of the journal are no episodes.
        journal_env_id: what the journal says it is of; None where it says nothing.
        videos: in the order of their names.
        reasons: why files cannot be read, by their names.
    """

    infix: str
    files: MonitorFiles
    manifest: Manifest | None
    stats: StatsFile | None
    entries: tuple[JournalEntry, ...] | None
    dropped: int
    journal_env_id: Any
    videos: tuple[RecordedVideo, ...]
    reasons: Mapping[str, str]

    @property
    def details(self) -> Mapping[str, Any]:
        """What the manifest says that gym's do not; nothing where there is none."""
        return {} if self.manifest is None else self.manifest.mjrec or {}


def recorded_monitors(directory: Path) -> Iterator[RecordedMonitor]:
    """Yield what the monitors of a directory have recorded, one after the other."""
    for files in monitors_of(directory):
        yield _read(directory, files)


def _read(directory: Path, files: MonitorFiles) -> RecordedMonitor:
    reasons: dict[str, str] = {}
    manifest = stats = entries = env_id = None
    dropped = 0
    with _noting(reasons):
        manifest = None if files.manifest is None else read_manifest(files.manifest)
    with _noting(reasons):
        stats = _stats(directory, files, manifest)
    with _noting(reasons):
        if files.journal is not None:
            entries, dropped, env_id = _entries(files.journal)
    return RecordedMonitor(
        infix=files.infix,
        files=files,
        manifest=manifest,
        stats=stats,
        entries=entries,
        dropped=dropped,
        journal_env_id=env_id,
        videos=tuple(_videos(directory, files.infix)),
        reasons=reasons,
    )


@contextlib.contextmanager
def _noting(reasons: dict[str, str]) -> Iterator[None]:
    try:
        yield
    except UnreadableFile as error:
        reasons[error.path.name] = error.reason


def _stats(
    directory: Path, files: MonitorFiles, manifest: Manifest | None
) -> StatsFile | None:
    path = files.stats if manifest is None else directory / manifest.stats
    return None if path is None else read_stats_file(path)


def _entries(journal: Path) -> tuple[tuple[JournalEntry, ...], int, Any]:
    run = Run()
    reader = JournalReader(journal, on_event=run.note)
    entries: list[JournalEntry] = []
    for entry in reader:
        entries.append(entry)
        if len(entries) > _MOST_EPISODES:
            raise UnreadableFile(journal, f"it has more than {_MOST_EPISODES} episodes")
    env_info = run.facts.get("env_info")
    env_id = env_info.get("env_id") if isinstance(env_info, Mapping) else None
    return tuple(entries), reader.dropped, env_id


def _videos(directory: Path, infix: str) -> Iterator[RecordedVideo]:
    prefix = f"openaigym.video.{infix}.video"
    names = sorted(
        path.name for path in directory.iterdir() if path.name.startswith(prefix)
    )
    known = set(names)
    for name in names:
        if name.endswith(".meta.json"):
            stem = name.removesuffix(".meta.json")
            text = f"{stem}.json"
            yield _video(directory, text if text in known else f"{stem}.mp4", known)
        elif name.endswith(".mp4") and metadata_path(Path(name)).name not in known:
            yield _video(directory, name, known)


def _video(directory: Path, name: str, known: set[str]) -> RecordedVideo:
    metadata: Mapping[str, Any] = {}
    with contextlib.suppress(OSError, ValueError):
        metadata = read_object(metadata_path(directory / name))
    number = episode_of(name)
    begins_with_episode = (
        not view_of(name) and ".step" not in name.rpartition(".video")[2]
    )
    return RecordedVideo(
        name=name,
        episode_id=-1 if number is None else number,
        is_main=begins_with_episode,
        is_there=name in known,
        metadata=metadata,
    )

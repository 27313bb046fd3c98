# SPDX-License-Identifier: Apache-2.0
"""What of a monitor directory is packed: all that its manifests vouch for.

Of each monitor: the manifest and what it names (statistics, finished videos, those
that broke), the journal, the frame hashes, the trajectories, and the models of these.
Locks, unfinished files, logs that nobody can read, second names of videos, and videos
that were rendered again another way are left out: no manifest knows them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...errors import (
    DirectoryInUse,
    DirectoryNotWritable,
    InvalidArgument,
    PackError,
    UnfinishedRecordings,
    UnknownName,
    UnreadableFile,
)
from ...formats.frame_hashes import frame_hash_path
from ...formats.json_fields import base_name, unreadable
from ...formats.locks import is_locked
from ...formats.manifest import Manifest, read_manifest
from ...formats.monitor_directory import (
    FILE_PREFIX,
    Infix,
    episode_of,
    infix_of,
    is_manifest,
    iter_monitor_files,
    trajectory_prefix,
    where_recordings_are,
)
from ...formats.regular_files import regular_path
from ...rendering.leftovers import leftovers_of
from ...rendering.recorded_facts import open_for_rendering
from ...rendering.recordings import look_at, recordings
from ...results import iter_episodes
from ...results.monitor_files import MonitorFiles, monitors_of

# In the key `mjrec` of a packed manifest: the episodes that were chosen for packing.
PACKED_EPISODES = "packed_episodes"

_RENDER = "To render what is pending: mjrec render {}"
_STRAY = (
    "There is no manifest of their monitor, which would say what they are. Put it "
    "back, or move them away."
)
_RECOVER = (
    "Their process was killed, or results are missing; to put that in order: mjrec "
    "recover {}"
)


@dataclass(frozen=True, kw_only=True)
class VideoFiles:
    """A finished video.

    Attributes:
        video: the file.
        metadata: all about it.
        trajectory: the recorded episode that it was, or could be, rendered from; None
            where it was not kept.
    """

    video: Path
    metadata: Path
    trajectory: Path | None


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What is packed.

    Attributes:
        directory: the monitor directory.
        files: those that are packed as they are, by the names that they get.
        manifests: by name, those that are packed with other content.
        videos: the finished videos among the files.
        surroundings: what the manifests say of where their recordings were made.
        packed_episodes: the numbers of the chosen episodes; None where all are packed.
    """

    directory: Path
    files: Mapping[str, Path]
    manifests: Mapping[str, Manifest]
    videos: tuple[VideoFiles, ...]
    surroundings: tuple[Mapping[str, Any], ...]
    packed_episodes: tuple[int, ...] | None


def look_for_contents(directory: Path, episodes: Iterable[int] | None) -> Contents:
    """Return what of a monitor directory is to be packed.

    Args:
        directory: the monitor directory.
        episodes: those whose videos and trajectories are packed; all, if None.

    Raises:
        InvalidArgument: it is no monitor directory, or an episode is no number.
        UnknownName: there is no such episode.
        DirectoryInUse: a monitor is open, or somebody renders.
        UnfinishedRecordings: videos are pending, or a monitor was killed.
        PackError: a file that is to be packed is gone, or has a name that archives
            cannot hold everywhere.
        UnreadableFile: a file is damaged, or a link that leads out of the directory.
    """
    _check_nobody_writes(directory)
    if not any(iter_monitor_files(directory)):
        raise InvalidArgument(
            f"{directory} holds no recordings that could be packed. "
            f"{where_recordings_are(directory)}"
        )
    _check_all_is_done(directory)
    chosen = None if episodes is None else _chosen(directory, episodes)
    found = _Found(directory, chosen)
    for monitor in monitors_of(directory):
        if monitor.manifest is not None:
            found.add_monitor(monitor.infix, monitor.manifest)
    found.add_models()
    return found.contents()


def _check_nobody_writes(directory: Path) -> None:
    for path in iter_monitor_files(directory, hidden=True):
        try:
            is_held = path.suffix == ".lock" and is_locked(path)
        except OSError as error:
            raise DirectoryNotWritable(directory, error.strerror) from error
        if is_held:
            what = (
                "a monitor that is still open writes there"
                if path.name == f".{FILE_PREFIX}.{infix_of(path.name)}.lock"
                else "somebody renders there"
            )
            raise DirectoryInUse(
                f"Cannot pack {directory}: {what} (it holds {path.name}). Close the "
                "monitor, or wait for the rendering, and pack then."
            )


def _check_all_is_done(directory: Path) -> None:
    closed = [files for files in monitors_of(directory) if not files.is_open]
    killed = [each.infix for each in closed if leftovers_of(directory, each)]
    if killed:
        raise UnfinishedRecordings(directory, killed, advice=_RECOVER.format(directory))
    strays = [name for files in closed for name in _strays(files)]
    if strays:
        raise UnfinishedRecordings(directory, strays, advice=_STRAY)
    pending = [
        key.told_name
        for key in recordings(directory)
        if look_at(directory, key) is not None
    ]
    if pending:
        raise UnfinishedRecordings(directory, pending, advice=_RENDER.format(directory))


def _strays(files: MonitorFiles) -> list[str]:
    """Return the names of files of a monitor that has no manifest."""
    names = [path.name for path in files.paths if not path.name.startswith(".")]
    return [] if any(map(is_manifest, names)) else names


def _chosen(directory: Path, episodes: Iterable[int]) -> frozenset[int]:
    """Return the numbers of the chosen episodes, checked.

    Raises:
        InvalidArgument: one is no number, or there are none.
        UnknownName: there is no such episode.
    """
    numbers = list(episodes)
    if not numbers or not all(type(number) is int for number in numbers):
        raise InvalidArgument(
            f"episodes is a list of the numbers of episodes, got {numbers!r}."
        )
    known = {episode.episode_id for episode in iter_episodes(directory)}
    known.update(
        number
        for path in iter_monitor_files(directory)
        if (number := episode_of(path.name)) is not None
    )
    for number in numbers:
        if number not in known:
            raise UnknownName(
                f"episode in {directory} with the number", number, _sorted_names(known)
            )
    return frozenset(numbers)


def _sorted_names(numbers: Iterable[int]) -> list[str]:
    return [str(number) for number in sorted(numbers)]


class _Found:
    """What is found to be packed, monitor by monitor."""

    def __init__(self, directory: Path, chosen: frozenset[int] | None) -> None:
        self._directory = directory
        self._chosen = chosen
        self._files: dict[str, Path] = {}
        self._manifests: dict[str, Manifest] = {}
        self._videos: list[VideoFiles] = []
        self._surroundings: list[Mapping[str, Any]] = []
        self._models: set[str] = set()
        self._of_infix: dict[str, list[Path]] = {}
        for path in iter_monitor_files(directory):
            self._of_infix.setdefault(infix_of(path.name) or "", []).append(path)

    def contents(self) -> Contents:
        return Contents(
            directory=self._directory,
            files=self._files,
            manifests=self._manifests,
            videos=tuple(self._videos),
            surroundings=tuple(self._surroundings),
            packed_episodes=None
            if self._chosen is None
            else tuple(sorted(self._chosen)),
        )

    def add_monitor(self, infix: str, path: Path) -> None:
        manifest = read_manifest(path)
        self._add_manifest(path, manifest)
        self._add(path.with_name(manifest.stats), of=path.name)
        for file in self._of_infix[infix]:
            if file.name.endswith((".jsonl", ".monitor.csv")):
                self._add(file)
            elif file.suffix == ".h5" and self._is_chosen(file.name):
                self._add_trajectory(file)
        for video, metadata in manifest.videos:
            if self._is_chosen(video):
                self._add_video(
                    path.with_name(video), path.with_name(metadata), path.name
                )
        with unreadable(path):
            for metadata in _broken_of(manifest):
                if self._is_chosen(metadata):
                    self._add_broken(path.with_name(metadata))

    def add_models(self) -> None:
        for name in self._models:
            # What it was made from may not be known, and a compiled one may be gone.
            if (self._directory / name).exists():
                self._add(self._directory / name)

    def _add_manifest(self, path: Path, manifest: Manifest) -> None:
        surroundings = (manifest.mjrec or {}).get("surroundings")
        if isinstance(surroundings, Mapping):
            self._surroundings.append(surroundings)
        if self._chosen is None:
            self._add(path)
            return
        if manifest.mjrec is None:
            raise InvalidArgument(
                f"{path.name} is gym's own, whose videos do not say which episode they "
                "show: its episodes cannot be chosen from. Pack all of them."
            )
        _check_name(path)
        details = {
            **manifest.mjrec,
            PACKED_EPISODES: sorted(self._chosen),
        }
        if "broken" in details:
            details["broken"] = [n for n in _broken_of(manifest) if self._is_chosen(n)]
        videos = tuple(pair for pair in manifest.videos if self._is_chosen(pair[0]))
        self._manifests[path.name] = replace(manifest, videos=videos, mjrec=details)

    def _add_video(self, video: Path, metadata: Path, manifest: str) -> None:
        self._add(video, of=manifest)
        self._add(metadata, of=manifest)
        if frame_hash_path(video).exists():
            self._add(frame_hash_path(video))
        trajectory = self._files.get(_trajectory_name(video.name))
        self._videos.append(
            VideoFiles(video=video, metadata=metadata, trajectory=trajectory)
        )

    def _add_broken(self, metadata: Path) -> None:
        """Add what there is of a video that ended early."""
        stem = metadata.name.removesuffix(".meta.json")
        for path in (metadata, *self._of_infix[infix_of(metadata.name) or ""]):
            if path.exists() and path.name in (
                metadata.name,
                *(f"{stem}{end}" for end in (".mp4", ".avi", ".json", ".framehash")),
            ):
                self._add(path)

    def _add_trajectory(self, path: Path) -> None:
        self._add(path)
        with open_for_rendering(path) as reader:
            model = reader.facts.get("model") or {}
        self._models.update(filter(None, (model.get("mjb"), model.get("xml"))))

    def _add(self, path: Path, *, of: str | None = None) -> None:
        _check_name(path)
        try:
            with unreadable(path):
                self._files[path.name] = regular_path(path)
        except UnreadableFile:
            if of is None or path.exists():
                raise
            raise PackError(
                f"{of} names {path.name}, which is not in {self._directory}. Put it "
                "back; a run that lacks what it names would not be verified."
            ) from None

    def _is_chosen(self, name: str) -> bool:
        return self._chosen is None or episode_of(name) in self._chosen


def _trajectory_name(video: str) -> str:
    """Return the name of the trajectory of a video's episode; "" for others' videos."""
    infix, number = Infix.parse(infix_of(video) or ""), episode_of(video)
    if infix is None or number is None:
        return ""
    return f"{trajectory_prefix(infix, number)}.h5"


def _broken_of(manifest: Manifest) -> Iterator[str]:
    """Yield the names of the metadata of videos that ended early, checked."""
    for name in (manifest.mjrec or {}).get("broken") or ():
        yield base_name(name)


def _check_name(path: Path) -> None:
    """Check that a name means the same file wherever it is unpacked."""
    try:
        path.name.encode()
        is_portable = path.name.isprintable() and "\\" not in path.name
    except UnicodeEncodeError:
        is_portable = False
    if not is_portable:
        raise PackError(
            f"{path.name!r} cannot be packed: on some systems that is no name of a "
            "file. Record with another uid."
        )

# SPDX-License-Identifier: Apache-2.0
"""Selection of the files to pack from monitor directories.

For each monitor, these are the manifest and the files that it names (statistics,
finished and broken videos), the journal, the frame hashes, the trajectories and their
models. Locks, unfinished files, unreadable logs, second names of videos, and videos
that were rerendered differently are left out, because no manifest names them.

If episodes are chosen, the trajectories of all other episodes are packed without states
and snapshots. Actions, rewards and seeds of every episode are kept, so all of them can
be recreated.
"""

from __future__ import annotations

import functools
import operator
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..atomic_files import writing
from ..errors import (
    DirectoryInUse,
    DirectoryNotWritable,
    InvalidArgument,
    PackError,
    UnfinishedRecordings,
    UnknownName,
    UnreadableFile,
)
from ..formats.bundle import file_of, finished_trajectories, trajectories_in
from ..formats.frame_hashes import frame_hash_path
from ..formats.journal import is_of_spans
from ..formats.json_fields import base_name, facts_in, unreadable
from ..formats.locks import is_locked
from ..formats.manifest import Manifest, read_manifest, write_manifest
from ..formats.monitor_directory import (
    FILE_PREFIX,
    episode_of,
    infix_of,
    is_bundle,
    iter_monitor_files,
    recording_directories,
    where_recordings_are,
)
from ..formats.regular_files import regular_path
from ..formats.trajectory import row_dtype
from ..formats.trajectory_hdf5 import open_hdf5, write_hdf5
from ..rendering.recorded_facts import open_for_rendering
from ..rendering.recordings import look_at, recordings
from ..rendering.recovery_needed import needs_recovery
from ..results import iter_episodes
from ..results.monitor_files import MonitorFiles, monitors_of
from .bag import TRY_AGAIN
from .layout import PACKED_EPISODES, STATES_LEFT_OUT
from .portable_names import portable_parts

_RENDER = "Render the pending videos with: mjrec render {}"
_STRAY = (
    "The manifest of their monitor is missing. Put it back, or move these files to "
    "another directory."
)
_RECOVER = (
    "Their process was killed, or results are missing. Recover them with: mjrec "
    "recover {}"
)
# Facts that are left out of the trajectories of episodes that were not chosen.
_OF_STATES = ("model", "video")
_OF_BROKEN_VIDEO = (".mp4", ".avi", ".json", ".framehash")


@dataclass(kw_only=True)
class Contents:
    """The contents of a packed run.

    Attributes:
        directory: the directory, as given.
        packed_episodes: the numbers of the chosen episodes. None if all are packed.
        files: for each packed file, keyed by name, a function that writes it to a path.
        provenance: the provenance in each manifest.
    """

    directory: Path
    packed_episodes: tuple[int, ...] | None
    files: dict[str, Callable[[Path], object]] = field(default_factory=dict)
    provenance: list[Mapping[str, Any]] = field(default_factory=list)

    def is_chosen(self, name: str) -> bool:
        """Return whether a file belongs to a chosen episode."""
        return self.packed_episodes is None or episode_of(name) in self.packed_episodes

    def add(self, path: Path, *, of: str | None = None) -> None:
        """Add a file. If `of` is given, it names the file that refers to this one."""
        try:
            with unreadable(path):
                source = regular_path(path)
        except UnreadableFile:
            if of is None or path.exists():
                raise
            raise PackError(
                f"{of} names {path.name}, which is missing from {self.directory}. Put "
                "it back: a run with missing files cannot be verified."
            ) from None
        write = _write_without_rows if path.suffix == ".jsonl" else link_or_copy
        self.put(path, functools.partial(write, source))

    def put(self, path: Path, write: Callable[[Path], object]) -> None:
        """Use `write` to write the packed copy of the file at `path`.

        Raises:
            PackError: the name is not valid on all systems.
        """
        try:
            portable_parts(path.name)
        except ValueError:
            raise PackError(
                f"{path.name!r} cannot be packed: it is not a valid file name on some "
                "systems. Record with a different uid."
            ) from None
        self.files[path.name] = write


def look_for_contents(directory: Path, episodes: Iterable[int] | None) -> Contents:
    """Return the files to pack from a monitor directory.

    Args:
        directory: the monitor directory, or one that contains several, such as an
            evaluation's.
        episodes: the numbers of the episodes whose videos and states are packed. All if
            None.

    Raises:
        InvalidArgument: `directory` contains no recordings, `episodes` is not a list of
            numbers, or `episodes` is given for several monitor directories.
        UnknownName: an episode does not exist.
        DirectoryInUse: a monitor is open, or another process is rendering.
        UnfinishedRecordings: videos are pending, or a monitor was killed.
        PackError: a file is missing, two directories have files with the same names, or
            a file's name is not portable.
        UnreadableFile: a file is damaged, or is a link that leads out of the directory.
    """
    places = recording_directories(directory)
    for place in places:
        _check_is_idle(place)
    if not any(map(any, map(iter_monitor_files, places))):
        raise InvalidArgument(
            f"{directory} contains no recordings to pack. "
            f"{where_recordings_are(directory)}"
        )
    for place in places:
        _check_all_is_done(place)
    chosen = None
    if episodes is not None:
        if len(places) > 1:
            raise InvalidArgument(
                f"{directory} contains {len(places)} monitor directories, each with "
                "its own episode numbers. To choose episodes, pack a single one."
            )
        chosen = _chosen(places[0], episodes)
    contents = Contents(directory=directory, packed_episodes=chosen)
    infixes: dict[str, Path] = {}
    for place in places:
        _add_all(contents, place, infixes)
    return contents


def _add_all(contents: Contents, place: Path, infixes: dict[str, Path]) -> None:
    """Add a directory's monitors, whose infixes must differ from earlier infixes."""
    for monitor in monitors_of(place):
        if monitor.manifest is None:
            continue
        if (other := infixes.setdefault(monitor.infix, place)) != place:
            raise PackError(
                f"{other} and {place} contain files with the same names (infix "
                f"{monitor.infix}). Pack each directory separately."
            )
        _add_monitor(contents, monitor.manifest, _visible(monitor))


def _visible(monitor: MonitorFiles) -> list[Path]:
    """Return a monitor's files without locks and unfinished files."""
    return [path for path in monitor.paths if not path.name.startswith(".")]


def _check_is_idle(directory: Path) -> None:
    for path in iter_monitor_files(directory, hidden=True):
        try:
            is_held = path.suffix == ".lock" and is_locked(path)
        except OSError as error:
            raise DirectoryNotWritable(directory, error.strerror) from error
        if is_held:
            what = (
                "an open monitor is writing there"
                if path.name == f".{FILE_PREFIX}.{infix_of(path.name)}.lock"
                else "another process is rendering there"
            )
            raise DirectoryInUse(
                f"Cannot pack {directory}: {what} (it holds the lock {path.name}). "
                "Close the monitor or wait for the rendering, then pack again."
            )


def _check_all_is_done(directory: Path) -> None:
    monitors = list(monitors_of(directory))
    killed = [each.infix for each in monitors if needs_recovery(each)]
    if killed:
        raise UnfinishedRecordings(directory, killed, advice=_RECOVER.format(directory))
    lost = [each for each in monitors if each.manifest is None]
    strays = [path.name for each in lost for path in _visible(each)]
    if strays:
        raise UnfinishedRecordings(directory, strays, advice=_STRAY)
    pending = [
        key.shown_name
        for key in recordings(directory)
        if look_at(directory, key) is not None
    ]
    if pending:
        raise UnfinishedRecordings(directory, pending, advice=_RENDER.format(directory))


def _chosen(directory: Path, episodes: Iterable[int]) -> tuple[int, ...]:
    """Return the numbers of the chosen episodes, sorted and without duplicates."""
    given = list(episodes)
    try:
        numbers = [operator.index(n) for n in given if not isinstance(n, bool)]
    except TypeError:
        numbers = []
    if not numbers or len(numbers) < len(given):
        raise InvalidArgument(
            f"episodes must be a list of episode numbers, got {given!r}."
        )
    known = {episode.episode_id for episode in iter_episodes(directory)}
    named = (*iter_monitor_files(directory), *finished_trajectories(directory))
    known |= {n for path in named if (n := episode_of(path.name)) is not None}
    for number in numbers:
        if number not in known:
            there = [str(each) for each in sorted(known)]
            raise UnknownName(f"episode in {directory} with the number", number, there)
    return tuple(sorted(set(numbers)))


def _add_monitor(contents: Contents, path: Path, files: list[Path]) -> None:
    manifest = read_manifest(path)
    _add_manifest(contents, path, manifest)
    contents.add(path.with_name(manifest.stats), of=path.name)
    for file in files:
        if file.name.endswith((".jsonl", ".monitor.csv")):
            contents.add(file)
        elif is_bundle(file.name):
            for bundled in trajectories_in(file):
                _add_trajectory(contents, bundled)
        elif file.suffix == ".h5":
            _add_trajectory(contents, file)
    for video, metadata in manifest.videos:
        if contents.is_chosen(video):
            contents.add(path.with_name(video), of=path.name)
            contents.add(path.with_name(metadata), of=path.name)
            hashes = frame_hash_path(path.with_name(video))
            if hashes.exists():
                contents.add(hashes)
    with unreadable(path):
        broken = [name for name in _broken_of(manifest) if contents.is_chosen(name)]
    for metadata in broken:
        stem = metadata.removesuffix(".meta.json")
        names = {metadata, *(f"{stem}{ending}" for ending in _OF_BROKEN_VIDEO)}
        for file in files:
            if file.name in names:
                contents.add(file)


def _add_manifest(contents: Contents, path: Path, manifest: Manifest) -> None:
    details = manifest.mjrec
    contents.provenance.append(facts_in((details or {}).get("provenance")))
    if contents.packed_episodes is None:
        contents.add(path)
        return
    if details is None:
        raise InvalidArgument(
            f"{path.name} is gym's own manifest, which does not say which episode "
            "each video shows, so episodes cannot be chosen. Pack all episodes."
        )
    details = {**details, PACKED_EPISODES: list(contents.packed_episodes)}
    if "broken" in details:
        broken = _broken_of(manifest)
        details["broken"] = [name for name in broken if contents.is_chosen(name)]
    videos = tuple(pair for pair in manifest.videos if contents.is_chosen(pair[0]))
    chosen = replace(manifest, videos=videos, mjrec=details)
    contents.put(path, functools.partial(write_manifest, manifest=chosen))


def _add_trajectory(contents: Contents, path: Path) -> None:
    if not contents.is_chosen(path.name):
        contents.put(path, functools.partial(_write_without_states, path))
        return
    if is_bundle(file_of(path).name):
        contents.put(path, functools.partial(_write_unbundled, path))
    else:
        contents.add(path)
    with open_for_rendering(path) as reader:
        model = reader.facts.get("model") or {}
    for name in filter(None, (model.get("mjb"), model.get("xml"))):
        # The sources may be missing, and a compiled model may have been removed.
        if path.with_name(name).exists():
            contents.add(path.with_name(name))


def _broken_of(manifest: Manifest) -> Iterator[str]:
    """Yield the names of broken videos' metadata files, each checked."""
    for name in (manifest.mjrec or {}).get("broken") or ():
        yield base_name(name)


def _write_without_rows(source: Path, target: Path) -> None:
    """Write a journal without its lines about row logs, which are not packed."""
    link_or_copy(source, target)
    lines = target.read_bytes().splitlines(keepends=True)
    rest = [line for line in lines if not is_of_spans(line)]
    if len(rest) < len(lines):
        # It may be a link to the original.
        target.unlink()
        target.write_bytes(b"".join(rest))


def _write_unbundled(source: Path, target: Path) -> None:
    with open_hdf5(source) as reader:
        write_hdf5(reader, target)


def _write_without_states(source: Path, target: Path) -> None:
    """Write a trajectory's actions, rewards and facts, without states to render."""
    with open_hdf5(source) as reader:
        facts = {k: v for k, v in reader.facts.items() if k not in _OF_STATES}
        kept = replace(
            reader,
            facts={**facts, STATES_LEFT_OUT: True},
            dtype=row_dtype(action=reader.kind("action")),
            frame_steps=np.empty(0, np.int64),
            change_count=0,
        )
        write_hdf5(kept, target)


def link_or_copy(source: Path, target: Path) -> None:
    """Create a file with the same content, as a hard link if possible."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        # A different file system, one without links, or a different user's file.
        _copy(source, target)
    if not stat.S_ISREG(target.lstat().st_mode):
        raise UnreadableFile(source, "it is no longer a regular file")
    if not os.access(target, os.R_OK):
        raise UnreadableFile(source, "permission denied")


def _copy(source: Path, target: Path) -> None:
    try:
        file = source.open("rb")
    except OSError as error:
        raise UnreadableFile(source, error.strerror) from error
    with writing(target, then=TRY_AGAIN), file, target.open("xb") as copy:
        shutil.copyfileobj(file, copy)

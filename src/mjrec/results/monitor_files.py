# SPDX-License-Identifier: Apache-2.0
"""Functions that find, sort and remove the files in a directory by monitor."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import DirectoryInUse
from ..formats.bundle import trajectories_in
from ..formats.journal import MOST_EPISODES
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    VideoName,
    episode_of,
    infix_of,
    infix_order,
    is_bundle,
    is_called_like_second,
    is_manifest,
    iter_monitor_files,
    log_number,
    names_in,
)
from ..formats.spans import LOG, recordings_in_flight

logger = logging.getLogger(__name__)


class MonitorFiles:
    """The files of one monitor.

    Args:
        infix: the infix that the files' names share.
        paths: the files.
        in_flight: the files that the recordings in flight will become.

    Attributes:
        infix: the infix that the files' names share.
        paths: the files.
        manifest: the manifest, if it exists.
        stats: the statistics file, if it exists.
        journal: the journal, if it exists.
        lock: the lock that claims the infix, if it exists. Killed monitors leave one.
        videos: the videos, by episode number.
        metadata: the videos' metadata, by episode number.
        trajectories: the trajectories, by episode number, including those that are in
            flight or in a bundle.
        logs: the row logs. A log is included as long as one of its files remains.
        last_episode_id: the highest episode number in a file name, including unfinished
            files; -1 if there is none.
    """

    def __init__(
        self, infix: str, paths: Iterable[Path], in_flight: Iterable[Path] = ()
    ) -> None:
        self.infix = infix
        self.paths = tuple(paths)
        self.manifest: Path | None = None
        self.stats: Path | None = None
        self.journal: Path | None = None
        self.lock: Path | None = None
        self.videos: dict[int, Path] = {}
        self.metadata: dict[int, Path] = {}
        self.trajectories: dict[int, Path] = {}
        self.logs: set[Path] = set()
        self.last_episode_id = -1
        for path in (*self.paths, *in_flight):
            self._sort_in(path)

    @property
    def is_open(self) -> bool:
        """Whether a running process holds the monitor's lock.

        Raises:
            OSError: the lock cannot be opened.
        """
        return self.lock is not None and is_locked(self.lock)

    def _sort_in(self, path: Path) -> None:
        number = episode_of(path.name)
        # The name is untrusted and may have any number of digits.
        if number is not None and number < MOST_EPISODES:
            self.last_episode_id = max(self.last_episode_id, number)
        video = VideoName.parse(path.name)
        if path.name == f".openaigym.{self.infix}.lock":
            self.lock = path
        elif path.name.startswith("."):
            return
        elif is_manifest(path.name):
            self.manifest = path
        elif path.name.endswith(".stats.json"):
            self.stats = path
        elif path.suffix == ".jsonl":
            self.journal = path
        elif video is not None and video.is_episodes:
            if video.ending in ("mp4", "avi", "json"):
                self.videos[video.episode_id] = path
            elif video.ending == "meta.json":
                self.metadata[video.episode_id] = path
        elif is_bundle(path.name):
            for bundled in trajectories_in(path):
                self._sort_in(bundled)
        elif log_number(path.name) is not None:
            self.logs.add(path.with_suffix(LOG))
        elif path.suffix == ".h5" and number is not None:
            self.trajectories[number] = path


def monitors_of(directory: Path) -> Iterator[MonitorFiles]:
    """Return an iterator over each monitor's files, including hidden ones, by infix.

    Trajectories include the files that recordings in flight will become. Monitors that
    have only a lock or an unfinished file are included.
    """
    files, in_flight = (
        _by_infix(path.name for path in iter_monitor_files(directory, hidden=True)),
        _by_infix(each.path.name for each in recordings_in_flight(directory)),
    )
    # There may be a hundred thousand files, and a path takes much more memory than a
    # name.
    return (
        MonitorFiles(
            infix,
            map(directory.joinpath, files.get(infix, ())),
            map(directory.joinpath, in_flight.get(infix, ())),
        )
        for infix in sorted({*files, *in_flight}, key=infix_order)
    )


def files_of(directory: Path, infix: str) -> MonitorFiles:
    """Return the current files of one monitor, including hidden ones."""
    # Test for the infix first, because all names in the directory are compared for each
    # dead monitor.
    own = f".{infix}."
    names = [n for n in names_in(directory) if own in n and infix_of(n) == infix]
    paths = [path for n in sorted(names) if (path := directory / n).is_file()]
    in_flight = [each.path for each in recordings_in_flight(directory, infix)]
    return MonitorFiles(infix, paths, in_flight)


def _by_infix(names: Iterable[str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        if (infix := infix_of(name)) is not None:
            grouped.setdefault(infix, []).append(name)
    return grouped


def detect_training_manifests(
    directory: str | os.PathLike[str], files: Iterable[str] | None = None
) -> list[str]:
    """Return the paths of the manifests in `directory`, sorted.

    Unfinished files and files with similar names are left out. For a missing directory,
    the list is empty.

    Args:
        directory: the directory to search; its subdirectories are not searched.
        files: names to choose from, instead of those in the directory.
    """
    directory = Path(directory)
    if files is None:
        files = (path.name for path in iter_monitor_files(directory))
    return [str(directory / name) for name in sorted(files) if is_manifest(name)]


def detect_monitor_files(directory: str | os.PathLike[str]) -> list[str]:
    """Return the paths of all finished monitor files in `directory`, sorted.

    Other files with a similar name (`openaigym.notes.txt`) are left out.
    """
    return [str(path) for path in iter_monitor_files(Path(directory))]


def clear_monitor_files(directory: str | os.PathLike[str]) -> None:
    """Remove the files of all monitors in `directory`, including unfinished ones.

    Links to their videos (`rl-video-episode-27.mp4`) are removed too. Directories and
    other files with similar names are kept.

    Raises:
        DirectoryInUse: a monitor in the directory is open. Nothing was removed.
    """
    paths = list(iter_monitor_files(Path(directory), hidden=True))
    for path in paths:
        if path.suffix == ".lock" and is_locked(path):
            raise DirectoryInUse(
                f"Cannot clear {directory}: an open monitor is writing to it (it holds "
                f"{path.name}). Close the monitor first, or use another directory."
            )
    # Remove links first, then manifests and journals, so that after an interruption
    # nothing refers to missing files.
    listings_first = sorted(paths, key=lambda path: not _is_listing(path.name))
    for path in (*_second_names(Path(directory), paths), *listings_first):
        path.unlink(missing_ok=True)
    logger.info("Removed %d monitor files from %s.", len(paths), directory)


def _second_names(directory: Path, paths: Iterable[Path]) -> list[Path]:
    """Return the other names that these files have in the directory."""
    # If a listed path is itself a link, its target is not the monitor's file.
    files = {file for path in paths if (file := _file(path, follow=False))}
    return [
        path
        for path in (directory.iterdir() if files else ())
        if is_called_like_second(path.name) and _file(path, follow=True) in files
    ]


def _file(path: Path, *, follow: bool) -> tuple[int, int] | None:
    """Return the identity of the file at a path, or None if it does not exist."""
    try:
        stat = path.stat(follow_symlinks=follow)
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _is_listing(name: str) -> bool:
    return is_manifest(name) or name.endswith(".jsonl")

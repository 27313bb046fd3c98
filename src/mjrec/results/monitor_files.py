# SPDX-License-Identifier: Apache-2.0
"""The files of a directory, monitor by monitor: found, sorted, and removed."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path

from ..errors import DirectoryInUse
from ..formats.bundle import trajectories_in
from ..formats.journal import MOST_EPISODES
from ..formats.locks import is_locked
from ..formats.monitor_directory import (
    Infix,
    VideoName,
    episode_of,
    infix_of,
    is_bundle,
    is_manifest,
    iter_monitor_files,
    log_number,
    names_in,
)
from ..formats.second_names import is_called_like_second
from ..formats.spans import LOG, recordings_in_flight

logger = logging.getLogger(__name__)


class MonitorFiles:
    """The files of one monitor.

    Args:
        infix: what their names have in common.
        paths: the files.
        in_flight: the files that recordings in flight will become.

    Attributes:
        infix: as given.
        paths: as given.
        manifest: its manifest, where there is one; likewise:
        stats: its statistics file.
        journal: its journal.
        lock: what it claimed its infix with; it is left where the monitor was killed.
        videos: its videos, by the numbers of their episodes.
        metadata: their metadata, likewise.
        trajectories: the own files of recorded states, likewise; also what is in
            flight, or in a bundle.
        logs: its row logs; one counts as long as a file beside it is left.
        last_episode_id: the highest number of an episode in a name, also of a file
            that was never finished; -1 where there is none.
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
        """Whether a living process holds the monitor's lock.

        Raises:
            OSError: the lock cannot be opened.
        """
        # Locks that are no monitor's are called alike.
        is_monitor = Infix.parse(self.infix) is not None
        return is_monitor and self.lock is not None and is_locked(self.lock)

    def _sort_in(self, path: Path) -> None:
        number = episode_of(path.name)
        # A name may hold any number of digits, and be anybody's.
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


def monitors_of(directory: Path) -> list[MonitorFiles]:
    """Return the files of each monitor, hidden ones too, in the order of the infixes.

    Files that recordings in flight will become are among their trajectories, and
    monitors with nothing but a lock or an unfinished file among them.
    """
    files, in_flight = (
        _by_infix(iter_monitor_files(directory, hidden=True)),
        _by_infix(recording.path for recording in recordings_in_flight(directory)),
    )
    return [
        MonitorFiles(infix, files.get(infix, ()), in_flight.get(infix, ()))
        for infix in sorted({*files, *in_flight}, key=_order)
    ]


def files_of(directory: Path, infix: Infix) -> MonitorFiles:
    """Return the files of one monitor as they are now, hidden ones too."""
    # Many names are compared, of whole directories, once for each dead monitor.
    own = f".{infix}."
    names = [n for n in names_in(directory) if own in n and infix_of(n) == str(infix)]
    paths = [path for n in sorted(names) if (path := directory / n).is_file()]
    in_flight = [each.path for each in recordings_in_flight(directory, infix)]
    return MonitorFiles(str(infix), paths, in_flight)


def _by_infix(paths: Iterable[Path]) -> dict[str, list[Path]]:
    grouped: dict[str, list[Path]] = {}
    for path in paths:
        if (infix := infix_of(path.name)) is not None:
            grouped.setdefault(infix, []).append(path)
    return grouped


def _order(infix: str) -> tuple[int, int, int, str]:
    parsed = Infix.parse(infix)
    if parsed is None:
        return (1, 0, 0, infix)
    # Process ids are numbers: 9 comes before 10.
    number = int(parsed.uid) if parsed.uid.isdecimal() else 0
    return (0, parsed.monitor_id, number, parsed.uid)


def detect_training_manifests(
    directory: str | os.PathLike[str], files: Iterable[str] | None = None
) -> list[str]:
    """Return the paths of the manifests in `directory`, sorted.

    Unfinished files and similar names are left out. A missing directory has none.

    Args:
        directory: where to look, not below it.
        files: names to choose from, instead of the directory's.
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
    """Remove the files of all monitors in `directory`, also unfinished ones.

    Also removes links to their videos (`rl-video-episode-27.mp4`), and nothing else: no
    directory, and no other file with a similar name.

    Raises:
        DirectoryInUse: a monitor there is open. Nothing was removed.
    """
    paths = list(iter_monitor_files(Path(directory), hidden=True))
    for path in paths:
        if path.suffix == ".lock" and is_locked(path):
            raise DirectoryInUse(
                f"Cannot clear {directory}: a monitor that is still open writes there "
                f"(it holds {path.name}). Close it first, or use another directory."
            )
    # Names that would lead nowhere first, then manifests and journals: if this is
    # interrupted, none lists what is gone.
    listings_first = sorted(paths, key=lambda path: not _is_listing(path.name))
    for path in (*_second_names(Path(directory), paths), *listings_first):
        path.unlink(missing_ok=True)
    logger.info("Removed %d monitor files from %s.", len(paths), directory)


def _second_names(directory: Path, paths: Iterable[Path]) -> list[Path]:
    """Return the other names in a directory of these files."""
    # A link's target is not the monitor's file.
    files = {file for path in paths if (file := _file(path, follow=False))}
    return [
        path
        for path in (directory.iterdir() if files else ())
        if is_called_like_second(path.name) and _file(path, follow=True) in files
    ]


def _file(path: Path, *, follow: bool) -> tuple[int, int] | None:
    """Return which file a name leads to; None where it leads to none."""
    try:
        stat = path.stat(follow_symlinks=follow)
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _is_listing(name: str) -> bool:
    return is_manifest(name) or name.endswith(".jsonl")

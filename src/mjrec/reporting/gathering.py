# SPDX-License-Identifier: Apache-2.0
"""Gathering of a report's contents from directories with recordings.

This needs no simulator, OpenGL or ffmpeg. Unreadable files are listed as problems, and
all other files are shown.
"""

from __future__ import annotations

import logging
import os
import shlex
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, UnreadableFile
from ..evaluation.evaluation import Evaluation, is_evaluation, read_results
from ..formats.json_fields import field as json_field
from ..formats.json_fields import (
    list_of,
    mapping,
    one_of,
    read_object,
    text,
    unreadable,
)
from ..formats.monitor_directory import monitor_directories_in
from ..results.episodes import Episode, episodes_of
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, monitors_of
from . import monitor_facts
from .contents import (
    ReportContents,
    ReportTask,
    ReportVideo,
    Verdict,
    episodes_with_roles,
    find_episodes,
    in_time,
    rows_of_monitor,
    summary_of_rows,
)

_package_logger = logging.getLogger(__package__.partition(".")[0])

Directories = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

_UNKNOWN_ENVIRONMENT: Final = "unknown environment"
_LONGEST_NAME: Final = 1000

# The name of the verdict file in a directory with recordings.
_VERIFICATION_NAME: Final = "verification.json"
_VERDICTS: Final = ("PASS", "PARTLY", "FAIL")
_OUTCOMES: Final = ("recreated", "within tolerance", "believed", "different")
_LEVELS: Final = ("files", "stats", "physics", "pixels")


def gather(
    directories: Directories,
    *,
    title: str | None = None,
    verifications: Iterable[str | os.PathLike[str]] = (),
) -> ReportContents:
    """Return the contents of a report, without copies of the videos.

    Args:
        directories: one or more evaluations, monitor directories, or folders that
            directly contain such directories.
        title: the page's title. None derives it from the recordings.
        verifications: outputs from `mjrec verify --json`, in addition to the
            `verification.json` in each directory.

    Raises:
        InvalidArgument: a directory has no recordings, or does not exist.
        UnreadableFile: a file in `verifications` cannot be read.
    """
    given = [_read_verdict(Path(path)) for path in verifications]
    found = _find_recordings(directories)
    contents = ReportContents()
    with _Noting(contents.problems):
        for directory in found:
            if is_evaluation(directory):
                _add_evaluation(contents, directory)
            else:
                _add_monitors(contents, directory, [directory])
            _add_verdict(contents, directory)
    contents.verdicts += given
    contents.problems[:] = dict.fromkeys(contents.problems)
    contents.title = title or _title(contents.tasks, found)
    names = Counter(task.name for task in contents.tasks)
    for task in contents.tasks:
        _complete(task)
        if names[task.name] > 1:
            task.name = f"{task.name} ({task.source})"
    return contents


# --- Directories ------------------------------------------------------------------


def _find_recordings(directories: Directories) -> list[Path]:
    """Return the directories with recordings, in order, without duplicates."""
    if isinstance(directories, str | os.PathLike):
        directories = [directories]
    found: dict[str, Path] = {}
    for directory in map(Path, directories):
        for each in _recordings_in(directory):
            found.setdefault(os.path.realpath(each), each)
    if not found:
        raise InvalidArgument(
            "A report needs at least one directory with recordings: the output of "
            "`mjrec evaluate` or `mjrec record`, or a Monitor's directory."
        )
    return [*found.values()]


def _recordings_in(directory: Path) -> list[Path]:
    """Return the directory if it has recordings, otherwise its folders with some."""
    if not directory.is_dir():
        what = "is a file" if directory.exists() else "does not exist"
        raise InvalidArgument(
            f"{directory} {what}. Pass the directory that `mjrec evaluate`, `mjrec "
            "record` (--out) or a Monitor wrote to."
        )
    try:
        # Links are skipped, because they may lead anywhere, even back into the folder.
        inside = (each for each in sorted(directory.iterdir()) if _is_folder(each))
        has_own = _has_recordings(directory)
        found = [directory] if has_own else [*filter(_has_recordings, inside)]
    except OSError as error:
        raise InvalidArgument(
            f"{directory} cannot be read: {error.strerror}. Pass a directory that you "
            "have permission to read."
        ) from error
    if not found:
        raise InvalidArgument(
            f"{directory} contains no recordings, and neither do its immediate "
            f"subfolders. To record an episode, run `mjrec record ENV --out "
            f"{shlex.quote(str(directory))}`; for many episodes, `mjrec evaluate`."
        )
    return found


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _has_recordings(directory: Path) -> bool:
    return is_evaluation(directory) or any(map(_has_episodes, monitors_of(directory)))


def _has_episodes(files: MonitorFiles) -> bool:
    return bool(files.manifest or files.stats or files.journal or files.videos)


# --- Monitors ---------------------------------------------------------------------


@dataclass
class _Recorded:
    """All monitors' recordings of one environment, in compact form."""

    # Only distinct pairs, in order, because there may be thousands of monitors.
    provenance: dict[tuple[str, str], None] = field(default_factory=dict)
    videos: list[ReportVideo] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)
    rows: list[NDArray[np.void]] = field(default_factory=list)


def _add_monitors(
    contents: ReportContents, directory: Path, places: Iterable[Path]
) -> None:
    """Add the recordings of monitors, with one task for each environment.

    Args:
        contents: the contents to extend.
        directory: the directory that the page refers to.
        places: the directories with the monitors' files.
    """
    by_name: dict[str, _Recorded] = {}
    for place, monitor in _monitors(contents, places):
        name = (monitor.env_info or {}).get("env_id")
        known = name[:_LONGEST_NAME] if isinstance(name, str) else ""
        recorded = by_name.setdefault(known or _UNKNOWN_ENVIRONMENT, _Recorded())
        recorded.videos += monitor_facts.recorded_videos(
            monitor, place, contents.problems
        )
        episodes = _readable_episodes(contents, monitor)
        recorded.rows.append(rows_of_monitor(episodes, run=len(recorded.runs)))
        recorded.runs.append(monitor.files.infix)
        recorded.provenance |= dict.fromkeys(monitor_facts.pairs_of_monitor(monitor))
    # Monitors that could not be read at all do not count as an environment.
    unknown = by_name.get(_UNKNOWN_ENVIRONMENT)
    if unknown and not unknown.videos and not any(map(len, unknown.rows)):
        del by_name[_UNKNOWN_ENVIRONMENT]
    for name, recorded in by_name.items():
        rows = in_time(np.concatenate(recorded.rows))
        # Do not keep two copies, because a million episodes take 60 MB.
        recorded.rows.clear()
        find_episodes(recorded.videos, rows, recorded.runs)
        contents.tasks.append(
            ReportTask(
                name=name,
                source=str(directory),
                is_evaluation=False,
                summary=summary_of_rows(name, rows, bootstrap=contents.bootstrap),
                episodes=rows,
                runs=recorded.runs,
                videos=recorded.videos,
                provenance=[*recorded.provenance, ("Environment", name)],
            )
        )
    if len(by_name) > 1:
        contents.problems.append(
            f"{directory} contains recordings of {len(by_name)} environments, "
            f"{', '.join(by_name)}. Each is shown separately."
        )


def _monitors(
    contents: ReportContents, places: Iterable[Path]
) -> Iterator[tuple[Path, MonitorResults]]:
    """Yield the monitors in directories, each with its directory.

    Callers should not keep the monitors: a manifest contains more than a page shows.
    """
    for place in places:
        try:
            found = monitors_of(place)
        except OSError as error:
            problem = f"{place} cannot be read: {error.strerror}."
            contents.problems.append(problem)
            continue
        for files in found:
            # A monitor may have left only its lock.
            if _has_episodes(files) or files.trajectories:
                yield place, MonitorResults(files)


def _readable_episodes(
    contents: ReportContents, monitor: MonitorResults
) -> Iterator[Episode]:
    read = 0
    try:
        for episode in episodes_of(monitor):
            yield episode
            read += 1
    except UnreadableFile as error:
        kept = f" The {read} episodes before it are shown." if read else ""
        contents.problems.append(f"{error}{kept}")


def _complete(task: ReportTask) -> None:
    """Merge a task's provenance, order its videos by episode, and set their roles."""
    renderers = [("OpenGL renderer", video.renderer or "") for video in task.videos]
    when = ("Recorded", monitor_facts.recorded_when(task.episodes))
    task.provenance = monitor_facts.joined([*task.provenance, *renderers, when])
    roles = episodes_with_roles(task)
    # Sorting is stable, so the order of cameras is kept.
    task.videos = sorted(task.videos, key=lambda v: (v.index is None, v.index or 0))
    for video in task.videos:
        if video.index is not None:
            video.roles = roles.get(video.index, ())


# --- Evaluations ------------------------------------------------------------------


def _add_evaluation(contents: ReportContents, directory: Path) -> None:
    try:
        # Without the timing file, the episode of a video is unknown.
        results = read_results(directory, needs_timing=True)
    except UnreadableFile as error:
        problem = f"{error} The recordings of its monitors are shown instead."
        contents.problems.append(problem)
        for folder in filter(_is_folder, sorted(directory.iterdir())):
            _add_monitors(contents, folder, _places_of_task(folder))
        return
    if not any(task.is_evaluation for task in contents.tasks):
        contents.bootstrap = results.bootstrap
    elif results.bootstrap != contents.bootstrap:
        how = results.bootstrap
        contents.problems.append(
            f"The intervals for {directory} were computed differently: {how.resamples} "
            f"resamples with seed {how.seed}, confidence {how.confidence:g}."
        )
    if results.across is not None and results.across.tasks:
        contents.across[str(directory)] = results.across
    for summary in results.summaries:
        task = summary.task
        provenance = [*monitor_facts.pairs_of_results(results, task)]
        videos = _videos_of_task(contents, results, task, provenance)
        contents.tasks.append(
            ReportTask(
                name=task[:_LONGEST_NAME],
                source=str(directory),
                is_evaluation=True,
                summary=summary,
                episodes=results.by_task[task].rows,
                failures=results.by_task[task].failures,
                videos=videos,
                provenance=provenance,
            )
        )


def _places_of_task(folder: Path) -> list[Path]:
    return [folder, *monitor_directories_in(folder)] if folder.is_dir() else []


def _videos_of_task(
    contents: ReportContents,
    results: Evaluation,
    task: str,
    provenance: list[tuple[str, str]],
) -> list[ReportVideo]:
    """Return the videos of a task's episodes, with the indices of the episodes.

    Videos without an episode are left out, because they come from a chunk that was
    killed and rerun.
    """
    columns, folder = results.by_task[task], results.folder(task)
    videos: list[ReportVideo] = []
    for place, monitor in _monitors(contents, _places_of_task(folder)):
        videos += monitor_facts.recorded_videos(monitor, place, contents.problems)
        provenance.append(monitor_facts.machine_of(monitor))
    find_episodes(videos, columns.rows, columns.monitors)
    shown = [video for video in videos if video.index is not None]
    missing = len(columns.videos.keys() - {video.index for video in shown})
    if missing:
        contents.problems.append(
            f"{missing} of {len(columns.videos)} videos of {task} are missing. If they "
            f"are pending, run `mjrec render {shlex.quote(str(folder))}`."
        )
    return shown


# --- Verdicts and title -----------------------------------------------------------


def _add_verdict(contents: ReportContents, directory: Path) -> None:
    path = directory / _VERIFICATION_NAME
    if os.path.lexists(path):
        try:
            contents.verdicts.append(_read_verdict(path))
        except UnreadableFile as error:
            contents.problems.append(str(error))


def _read_verdict(path: Path) -> Verdict:
    """Return the verdict in output from `mjrec verify --json`.

    Raises:
        UnreadableFile: the file is missing, damaged, inconsistent or of a different
            kind.
    """
    with unreadable(path):
        verification = read_object(path)
        verdict = json_field(verification, "verdict", one_of(*_VERDICTS))
        findings = json_field(verification, "findings", list_of(mapping))
        outcomes = Counter(json_field(each, "outcome", text) for each in findings)
        if verdict != "FAIL" and outcomes["different"]:
            raise ValueError(
                f"its verdict is {verdict}, but {outcomes['different']} items differ"
            )
        return Verdict(
            source=f"{json_field(verification, 'path', text)} ({path})",
            verdict=verdict,
            counts={name: outcomes[name] for name in _OUTCOMES if outcomes[name]},
            level=json_field(verification, "level", one_of(*_LEVELS)),
        )


def _title(tasks: Iterable[ReportTask], found: Iterable[Path]) -> str:
    what = "Evaluation" if all(map(is_evaluation, found)) else "Recordings"
    names = [task.name for task in tasks]
    if len(set(names)) == 1:
        return f"{what}: {names[0]}"
    return f"{what}: {len(names)} tasks" if names else what


class _Noting(logging.Handler):
    """A log handler that collects this thread's warnings about skipped content."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._problems, self._thread = problems, threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self._problems.append(record.getMessage())

    def __enter__(self) -> None:
        _package_logger.addHandler(self)

    def __exit__(self, *_: object) -> None:
        _package_logger.removeHandler(self)

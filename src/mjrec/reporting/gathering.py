# SPDX-License-Identifier: Apache-2.0
"""All that a report shows, gathered from directories with recordings.

Nothing of it needs a simulator, OpenGL or ffmpeg. A file that cannot be read is named
among the problems, and the rest is shown.
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
from .contents import ReportContents, ReportTask, ReportVideo, Verdict
from .episode_rows import (
    episodes_with_roles,
    in_time,
    rows_of_monitor,
    rows_of_results,
    summary_of_rows,
)
from .provenance import (
    Provenance,
    machine_of,
    pairs_of_monitor,
    pairs_of_results,
    recorded_when,
)
from .recorded_videos import recorded_videos

_package_logger = logging.getLogger(__package__.partition(".")[0])

Directories = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

_UNKNOWN_ENVIRONMENT: Final = "unknown environment"
_LONGEST_NAME: Final = 1000
_NO_MONITOR: Final = -2

# Where a verdict is looked for, in each directory with recordings.
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
    """Return all of a report, whose videos have no files in it yet.

    Args:
        directories: of evaluations, of monitors, or folders with such directories in
            them (not deeper); one, or several.
        title: of the page; a sentence about what was recorded, if None.
        verifications: files that `mjrec verify --json` has printed, besides the
            `verification.json` of each directory.

    Raises:
        InvalidArgument: a directory has no recordings, or is not there.
        UnreadableFile: one of `verifications`.
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
        if names[task.name] > 1:
            task.name = f"{task.name} ({task.source})"
    return contents


# --- Directories ------------------------------------------------------------------


def _find_recordings(directories: Directories) -> list[Path]:
    """Return the directories that have recordings, each once, in their order."""
    if isinstance(directories, str | os.PathLike):
        directories = [directories]
    found: dict[str, Path] = {}
    for directory in map(Path, directories):
        for each in _recordings_in(directory):
            found.setdefault(os.path.realpath(each), each)
    if not found:
        raise InvalidArgument(
            "A report needs at least one directory with recordings: that of `mjrec "
            "evaluate` or `mjrec record`, or one that a Monitor wrote into."
        )
    return [*found.values()]


def _recordings_in(directory: Path) -> list[Path]:
    """Return a directory that has recordings, or those directly in it that have."""
    if not directory.is_dir():
        what = "is a file" if directory.exists() else "is not there"
        raise InvalidArgument(
            f"{directory} {what}. Name the directory that `mjrec evaluate` or `mjrec "
            "record` wrote into (--out), or that a Monitor did."
        )
    try:
        # A link may lead anywhere, also to what is in the folder itself.
        inside = (each for each in sorted(directory.iterdir()) if _is_folder(each))
        has_own = _has_recordings(directory)
        found = [directory] if has_own else [*filter(_has_recordings, inside)]
    except OSError as error:
        raise InvalidArgument(
            f"{directory} cannot be looked into: {error.strerror}. Name one that this "
            "user may read."
        ) from error
    if not found:
        raise InvalidArgument(
            f"{directory} holds no recordings, and neither do the folders directly in "
            f"it. `mjrec record ENV --out {shlex.quote(str(directory))}` makes some; "
            "`mjrec evaluate` makes some of many episodes."
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
    """What monitors recorded of one environment, of whose files little is kept."""

    provenance: Provenance = field(default_factory=Provenance)
    videos: list[ReportVideo] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)
    rows: list[NDArray[np.void]] = field(default_factory=list)


def _add_monitors(
    contents: ReportContents, directory: Path, places: Iterable[Path]
) -> None:
    """Add what monitors recorded: a task for each environment.

    Args:
        contents: to add to.
        directory: that the page names.
        places: where the monitors' files are.
    """
    by_name: dict[str, _Recorded] = {}
    for place, monitor in _monitors(contents, places):
        name = (monitor.env_info or {}).get("env_id")
        known = name[:_LONGEST_NAME] if isinstance(name, str) else ""
        recorded = by_name.setdefault(known or _UNKNOWN_ENVIRONMENT, _Recorded())
        _add_monitor(contents, recorded, monitor, place)
    # Files that nothing can be read from are of no environment.
    unknown = by_name.get(_UNKNOWN_ENVIRONMENT)
    if unknown and not unknown.videos and not any(map(len, unknown.rows)):
        del by_name[_UNKNOWN_ENVIRONMENT]
    for name, recorded in by_name.items():
        rows, now_at = in_time(np.concatenate(recorded.rows))
        for video in recorded.videos:
            if video.index is not None:
                video.index = int(now_at[video.index])
        recorded.provenance.add([("Environment", name)])
        recorded.provenance.add([("Recorded", recorded_when(rows))])
        contents.tasks.append(
            ReportTask(
                name=name,
                source=str(directory),
                is_evaluation=False,
                summary=summary_of_rows(name, rows, bootstrap=contents.bootstrap),
                episodes=rows,
                runs=recorded.runs,
                videos=_in_order(recorded.videos, rows),
                provenance=recorded.provenance.pairs(),
            )
        )
    if len(by_name) > 1:
        contents.problems.append(
            f"{directory} holds recordings of {len(by_name)} environments, "
            f"{', '.join(by_name)}: each is shown by itself."
        )


def _monitors(
    contents: ReportContents, places: Iterable[Path]
) -> Iterator[tuple[Path, MonitorResults]]:
    """Yield the monitors of directories; the caller keeps none of them.

    A page shows little of what a manifest says about the machine.
    """
    for place in places:
        try:
            found = monitors_of(place)
        except OSError as error:
            problem = f"{place} cannot be looked into: {error.strerror}."
            contents.problems.append(problem)
            continue
        for files in found:
            # There may be no more of it than its lock.
            if _has_episodes(files) or files.trajectories:
                yield place, MonitorResults(files)


def _add_monitor(
    contents: ReportContents, recorded: _Recorded, monitor: MonitorResults, place: Path
) -> None:
    videos = recorded_videos(monitor, place, contents.problems)
    wanted = {video.episode_id for video in videos}
    before = sum(map(len, recorded.rows))
    rows, found = rows_of_monitor(
        _readable_episodes(contents, monitor), run=len(recorded.runs), wanted=wanted
    )
    for video in videos:
        if video.episode_id in found:
            video.index = before + found[video.episode_id]
    recorded.runs.append(monitor.files.infix)
    recorded.rows.append(rows)
    recorded.videos += videos
    recorded.provenance.add(pairs_of_monitor(monitor))
    recorded.provenance.add(_renderers(videos))


def _readable_episodes(
    contents: ReportContents, monitor: MonitorResults
) -> Iterator[Episode]:
    read = 0
    try:
        for episode in episodes_of(monitor):
            yield episode
            read += 1
    except UnreadableFile as error:
        kept = f" {read} episodes before that are shown." if read else ""
        contents.problems.append(f"{error}{kept}")


def _renderers(videos: Iterable[ReportVideo]) -> list[tuple[str, str]]:
    return [("OpenGL of the videos", video.renderer or "") for video in videos]


def _in_order(
    videos: Iterable[ReportVideo], rows: NDArray[np.void]
) -> list[ReportVideo]:
    """Return videos in the order of their episodes, with the roles of these."""
    roles = episodes_with_roles(rows)
    # Sorting keeps the order of views.
    ordered = sorted(videos, key=lambda video: (video.index is None, video.index or 0))
    for video in ordered:
        if video.index is not None:
            video.roles = roles.get(video.index, ())
    return ordered


# --- Evaluations ------------------------------------------------------------------


def _add_evaluation(contents: ReportContents, directory: Path) -> None:
    try:
        # Without times nothing tells which episode a video shows.
        results = read_results(directory, needs_timing=True)
    except UnreadableFile as error:
        problem = f"{error} What its monitors recorded is shown instead."
        contents.problems.append(problem)
        for folder in filter(_is_folder, sorted(directory.iterdir())):
            _add_monitors(contents, folder, _places_of_task(folder))
        return
    if not any(task.is_evaluation for task in contents.tasks):
        contents.bootstrap = results.bootstrap
    elif results.bootstrap != contents.bootstrap:
        how = results.bootstrap
        contents.problems.append(
            f"The intervals of {directory} were made in another way: {how.resamples} "
            f"resamples with seed {how.seed}, {how.confidence:g}."
        )
    if results.across is not None:
        contents.across[str(directory)] = results.across
    for summary in results.summaries:
        task = summary.task
        rows = rows_of_results(results.by_task[task])
        provenance = Provenance(pairs_of_results(results, task))
        videos = _videos_of_task(contents, results, task, provenance)
        provenance.add([("Recorded", recorded_when(rows))])
        contents.tasks.append(
            ReportTask(
                name=task[:_LONGEST_NAME],
                source=str(directory),
                is_evaluation=True,
                summary=summary,
                episodes=rows,
                failures=results.by_task[task].failures,
                videos=_in_order(videos, rows),
                provenance=provenance.pairs(),
            )
        )


def _places_of_task(folder: Path) -> list[Path]:
    return [folder, *monitor_directories_in(folder)] if folder.is_dir() else []


def _videos_of_task(
    contents: ReportContents, results: Evaluation, task: str, provenance: Provenance
) -> list[ReportVideo]:
    """Return the videos of a task's episodes, with the places of these.

    Others are of a batch that was begun, killed and done again.
    """
    columns, folder = results.by_task[task], results.folder(task)
    videos: list[ReportVideo] = []
    for place, monitor in _monitors(contents, _places_of_task(folder)):
        videos += recorded_videos(monitor, place, contents.problems)
        provenance.add([machine_of(monitor)])
    provenance.add(_renderers(videos))
    number = {infix: index for index, infix in enumerate(columns.monitors)}
    for video in videos:
        given = columns.rows
        of_monitor = given["monitor"] == number.get(video.infix, _NO_MONITOR)
        [rows] = np.nonzero(of_monitor & (given["episode_id"] == video.episode_id))
        video.index = int(rows[0]) if len(rows) else None
    shown = [video for video in videos if video.index is not None]
    missing = len(columns.videos.keys() - {video.index for video in shown})
    if missing:
        contents.problems.append(
            f"{missing} of {len(columns.videos)} videos of {task} are not there. Where "
            f"they are pending, `mjrec render {shlex.quote(str(folder))}` makes them."
        )
    return shown


# --- Beside them ------------------------------------------------------------------


def _add_verdict(contents: ReportContents, directory: Path) -> None:
    path = directory / _VERIFICATION_NAME
    if os.path.lexists(path):
        try:
            contents.verdicts.append(_read_verdict(path))
        except UnreadableFile as error:
            contents.problems.append(str(error))


def _read_verdict(path: Path) -> Verdict:
    """Return what a file says that `mjrec verify --json` has printed.

    Raises:
        UnreadableFile: it is missing, damaged, something else, or contradicts itself.
    """
    with unreadable(path):
        verification = read_object(path)
        verdict = json_field(verification, "verdict", one_of(*_VERDICTS))
        findings = json_field(verification, "findings", list_of(mapping))
        outcomes = Counter(json_field(each, "outcome", text) for each in findings)
        if verdict != "FAIL" and outcomes["different"]:
            raise ValueError(
                f"it says {verdict}, and that {outcomes['different']} items differ"
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
    """Notes what the readers of files warn of in this thread: what they leave out."""

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

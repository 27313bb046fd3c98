# SPDX-License-Identifier: Apache-2.0
"""All that a report shows, gathered from directories with recordings.

Nothing of it needs a simulator, OpenGL or ffmpeg. A file that cannot be read is named
among the problems, and the rest is shown.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import logging
import os
import platform
import shlex
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import UnreadableFile
from ..evaluation.results_files import ReadResults, read_results, read_summaries
from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import AcrossTasks, TaskSummary
from ..formats.monitor_directory import monitor_directories_in
from ..results.episodes import episodes_of
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, monitors_of
from .contents import EpisodeColumns, ReportContents, ReportTask, ReportVideo, Verdict
from .episode_columns import (
    EpisodeRows,
    columns_of_results,
    episodes_with_roles,
    summary_of_columns,
    what_disagrees,
)
from .found_recordings import FoundRecordings, find_recordings
from .provenance import (
    MonitorOrigin,
    origin_of,
    provenance_of_evaluation,
    provenance_of_monitors,
)
from .recorded_videos import RecordedVideo, recorded_videos, report_video
from .verdicts import VERIFICATION_NAME, read_verdict

_UNKNOWN_ENVIRONMENT = "unknown environment"
_LONGEST_NAME = 1000


def gather(
    directories: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    title: str | None = None,
    verifications: Iterable[str | os.PathLike[str]] = (),
) -> ReportContents:
    """Return all of a report, with the recorded videos' own paths and no posters.

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
    given = [read_verdict(Path(path)) for path in verifications]
    found = find_recordings(directories)
    gathering = _Gathering()
    with gathering.noting_warnings():
        for recordings in found:
            gathering.add(recordings)
    return gathering.contents(title, found, given)


@dataclass
class _Task:
    """A task, and its videos before they have a place among all of them."""

    task: ReportTask
    videos: Sequence[tuple[RecordedVideo, int | None]]


class _Monitors:
    """Monitors that recorded the same, of whose files little is kept.

    Args:
        problems: is added to where something cannot be read.
        reads_episodes: whether their episodes are wanted.
    """

    def __init__(self, problems: list[str], *, reads_episodes: bool) -> None:
        self.origins: list[MonitorOrigin] = []
        self.videos: list[RecordedVideo] = []
        self._rows = EpisodeRows() if reads_episodes else None
        self._problems = problems

    def add(self, monitor: MonitorResults) -> None:
        """Add what is shown of a monitor."""
        self.origins.append(origin_of(monitor))
        videos = recorded_videos(monitor, self._problems)
        self.videos += videos
        if self._rows is not None:
            numbers = (video.episode_id for video in videos)
            self._rows.begin(monitor.files.infix, {n for n in numbers if n is not None})
            self._read_episodes(monitor, self._rows)

    def recorded(self) -> _Recorded:
        """Return the episodes, and which of them the videos show."""
        assert self._rows is not None
        columns, places = self._rows.columns()
        placed = [
            (video, places.get((video.infix, video.episode_id or 0)))
            if video.episode_id is not None
            else (video, None)
            for video in self.videos
        ]
        return _Recorded(columns, placed, self._rows.run_count)

    def _read_episodes(self, monitor: MonitorResults, rows: EpisodeRows) -> None:
        before = len(rows)
        try:
            for episode in episodes_of(monitor):
                rows.add(episode)
        except UnreadableFile as error:
            read = len(rows) - before
            kept = f" {read} episodes before that are shown." if read else ""
            self._problems.append(f"{error}{kept}")


@dataclass(frozen=True)
class _Recorded:
    """The episodes of monitors, their videos, and how many monitors have episodes."""

    columns: EpisodeColumns
    placed: Sequence[tuple[RecordedVideo, int | None]]
    runs: int


class _Gathering:
    """What has been gathered so far."""

    def __init__(self) -> None:
        self._tasks: list[_Task] = []
        self._across: dict[str, AcrossTasks] = {}
        self._bootstraps: dict[str, Bootstrap] = {}
        self._problems: list[str] = []
        self._verdicts: list[Verdict] = []

    @contextlib.contextmanager
    def noting_warnings(self) -> Iterator[None]:
        """Note what the readers of files warn of: what they leave out."""
        handler = _NotingHandler(self._problems)
        logger = logging.getLogger(__package__.partition(".")[0])
        logger.addHandler(handler)
        try:
            yield
        finally:
            logger.removeHandler(handler)

    def add(self, recordings: FoundRecordings) -> None:
        """Add a directory."""
        directory = recordings.directory
        if recordings.is_evaluation:
            self._add_evaluation(directory)
        else:
            self._add_monitors(directory)
        self._add_verdict(directory)

    def contents(
        self,
        title: str | None,
        found: Sequence[FoundRecordings],
        verdicts: Sequence[Verdict],
    ) -> ReportContents:
        """Return all of it."""
        names = Counter(each.task.name for each in self._tasks)
        tasks = [
            dataclasses.replace(task, name=f"{task.name} ({task.source})")
            if names[task.name] > 1
            else task
            for task in (each.task for each in self._tasks)
        ]
        placed, videos = self._placed(tasks)
        bootstrap = self._bootstrap()
        return ReportContents(
            title=title or _title(tasks, found),
            tasks=placed,
            videos=videos,
            across=self._across,
            bootstrap=bootstrap,
            problems=tuple(dict.fromkeys(self._problems)),
            verdicts=(*self._verdicts, *verdicts),
            made_with={
                "mjrec": importlib.metadata.version("mjrec"),
                "Python": platform.python_version(),
            },
        )

    def _placed(
        self, tasks: Sequence[ReportTask]
    ) -> tuple[list[ReportTask], list[ReportVideo]]:
        """Return the tasks, whose episodes know their videos, and all videos."""
        placed: list[ReportTask] = []
        videos: list[ReportVideo] = []
        for number, (task, each) in enumerate(zip(tasks, self._tasks, strict=True)):
            roles = episodes_with_roles(task.episodes)
            of_episodes: dict[int, list[int]] = {}
            for video, index in _in_order(each.videos):
                if index is not None:
                    of_episodes.setdefault(index, []).append(len(videos))
                told = () if index is None else roles.get(index, ())
                videos.append(report_video(video, task=number, index=index, roles=told))
            episodes = dataclasses.replace(task.episodes, videos=of_episodes)
            placed.append(dataclasses.replace(task, episodes=episodes))
        return placed, videos

    def _bootstrap(self) -> Bootstrap:
        known = [*self._bootstraps.values()]
        if any(bootstrap != known[0] for bootstrap in known[1:]):
            listed = "; ".join(
                f"{name}: {b.resamples} resamples with seed {b.seed}, {b.confidence:g}"
                for name, b in self._bootstraps.items()
            )
            self._problems.append(
                f"The evaluations' intervals were not made alike: {listed}."
            )
        return known[0] if known else Bootstrap()

    def _add_verdict(self, directory: Path) -> None:
        path = directory / VERIFICATION_NAME
        if not os.path.lexists(path):
            return
        try:
            self._verdicts.append(read_verdict(path))
        except UnreadableFile as error:
            self._problems.append(str(error))

    # Evaluations.

    def _add_evaluation(self, directory: Path) -> None:
        try:
            # Without times nothing tells which episode a video shows.
            results = read_results(directory, needs_timing=True)
        except UnreadableFile as error:
            self._add_evaluation_without_tables(directory, error)
            return
        self._add_figures(results)
        source = str(directory)
        for summary in results.summaries:
            task = summary.task
            columns = columns_of_results(results.columns[task])
            self._note_disagreement(source, summary, columns)
            folder = results.folder(task)
            monitors = self._monitors_of(folder, reads_episodes=False)
            placed = _placed_in_results(results, task, monitors.videos)
            self._note_missing(results, task, folder, placed)
            self._tasks.append(
                _Task(
                    ReportTask(
                        name=task[:_LONGEST_NAME],
                        source=source,
                        is_evaluation=True,
                        summary=summary,
                        episodes=columns,
                        provenance=provenance_of_evaluation(
                            results, task, monitors.origins, monitors.videos, columns
                        ),
                    ),
                    placed,
                )
            )

    def _add_evaluation_without_tables(
        self, directory: Path, why: UnreadableFile
    ) -> None:
        """Add the figures that there are, and the episodes that monitors recorded."""
        try:
            results = read_summaries(directory)
        except UnreadableFile:
            self._problems.append(f"{why} What its monitors recorded is shown instead.")
            self._add_below(directory)
            return
        self._problems.append(
            f"{why} The summaries are those of results.json; the list of episodes is "
            "what the monitors recorded, and episodes that failed are not in it."
        )
        self._add_figures(results)
        for summary in results.summaries:
            folder = results.folder(summary.task)
            monitors = self._monitors_of(folder, reads_episodes=True)
            recorded = monitors.recorded()
            self._tasks.append(
                _Task(
                    ReportTask(
                        name=summary.task[:_LONGEST_NAME],
                        source=str(folder),
                        is_evaluation=False,
                        summary=summary,
                        episodes=recorded.columns,
                        provenance=provenance_of_evaluation(
                            results,
                            summary.task,
                            monitors.origins,
                            monitors.videos,
                            recorded.columns,
                        ),
                    ),
                    recorded.placed,
                )
            )

    def _add_figures(self, results: ReadResults) -> None:
        """Add what is said of all tasks."""
        source = str(results.directory)
        self._bootstraps[source] = results.bootstrap
        if results.across is not None:
            self._across[source] = results.across

    def _add_below(self, directory: Path) -> None:
        """Add the monitor directories of an evaluation without results."""
        for folder in monitor_directories_in(directory):
            self._add_monitors(folder)

    def _note_disagreement(
        self, source: str, summary: TaskSummary, columns: EpisodeColumns
    ) -> None:
        differing = what_disagrees(summary, columns)
        if differing:
            self._problems.append(
                f"{summary.task} in {source}: results.json and results.csv disagree "
                f"about {', '.join(differing)}. One of them was changed after "
                "they were written."
            )

    def _note_missing(
        self,
        results: ReadResults,
        task: str,
        folder: Path,
        placed: Sequence[tuple[RecordedVideo, int | None]],
    ) -> None:
        expected = results.columns[task].videos.keys()
        missing = len(expected - {index for _, index in placed})
        if missing:
            named = shlex.quote(str(folder))
            self._problems.append(
                f"{missing} of {len(expected)} videos of {task} are not there. Where "
                f"they are pending, `mjrec render {named}` makes them."
            )

    # Monitor directories.

    def _add_monitors(self, directory: Path) -> None:
        groups: dict[str, _Monitors] = {}
        for monitor in self._monitors(directory):
            name = self._environment(monitor)
            if name not in groups:
                groups[name] = _Monitors(self._problems, reads_episodes=True)
            groups[name].add(monitor)
        before = len(self._tasks)
        for name, group in groups.items():
            self._add_group(directory, name, group)
        names = [each.task.name for each in self._tasks[before:]]
        if len(names) > 1:
            self._problems.append(
                f"{directory} holds recordings of {len(names)} environments, "
                f"{', '.join(names)}: each is shown by itself."
            )

    def _add_group(self, directory: Path, name: str, group: _Monitors) -> None:
        recorded = group.recorded()
        columns = recorded.columns
        if (
            name == _UNKNOWN_ENVIRONMENT
            and not len(columns.run)
            and not recorded.placed
        ):
            # Files that nothing can be read from.
            return
        bootstrap = next(iter(self._bootstraps.values()), Bootstrap())
        self._tasks.append(
            _Task(
                ReportTask(
                    name=name,
                    source=str(directory),
                    is_evaluation=False,
                    summary=summary_of_columns(
                        name, columns, runs=recorded.runs, bootstrap=bootstrap
                    ),
                    episodes=columns,
                    provenance=provenance_of_monitors(
                        name, group.origins, group.videos, columns
                    ),
                ),
                recorded.placed,
            )
        )

    def _monitors_of(self, folder: Path, *, reads_episodes: bool) -> _Monitors:
        """Return the monitors of a task."""
        monitors = _Monitors(self._problems, reads_episodes=reads_episodes)
        for chunk in monitor_directories_in(folder) if folder.is_dir() else ():
            for monitor in self._monitors(chunk):
                monitors.add(monitor)
        return monitors

    def _monitors(self, directory: Path) -> Iterator[MonitorResults]:
        """Yield the monitors of a directory; whoever asks keeps none of them.

        A manifest says much of the machine, of which a page shows little.
        """
        try:
            found = monitors_of(directory)
        except OSError as error:
            self._problems.append(
                f"{directory} cannot be looked into: {error.strerror}."
            )
            return
        yield from map(MonitorResults, filter(_has_something, found))

    def _environment(self, monitor: MonitorResults) -> str:
        name = (monitor.env_info or {}).get("env_id")
        is_name = isinstance(name, str) and name
        return str(name)[:_LONGEST_NAME] if is_name else _UNKNOWN_ENVIRONMENT


class _NotingHandler(logging.Handler):
    """Puts warnings of this thread into a list."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._problems = problems
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self._problems.append(record.getMessage())


def _has_something(files: MonitorFiles) -> bool:
    """Tell whether there is more of a monitor than its lock."""
    return bool(
        files.manifest
        or files.stats
        or files.journal
        or files.videos
        or files.trajectories
    )


def _placed_in_results(
    results: ReadResults, task: str, videos: Iterable[RecordedVideo]
) -> list[tuple[RecordedVideo, int | None]]:
    """Return videos with the indices of the episodes that they show."""
    columns = results.columns[task]
    shown = list(videos)
    number = {infix: index for index, infix in enumerate(columns.monitors)}
    keys = [(number.get(video.infix), video.episode_id) for video in shown]
    wanted = set(keys)
    index: dict[tuple[int | None, int | None], int] = {}
    recorded = zip(columns.monitor, columns.episode_id, strict=True)
    for row, key in enumerate(recorded if wanted else ()):
        if key in wanted:
            index.setdefault(key, row)
    # Others are of a batch that was begun, killed and done again.
    return [
        (video, index[key])
        for video, key in zip(shown, keys, strict=True)
        if None not in key and key in index
    ]


def _in_order(
    videos: Iterable[tuple[RecordedVideo, int | None]],
) -> list[tuple[RecordedVideo, int | None]]:
    """Return videos in the order of their episodes; sorting keeps that of views."""
    return sorted(videos, key=lambda each: (each[1] is None, each[1] or 0))


def _title(tasks: Sequence[ReportTask], found: Sequence[FoundRecordings]) -> str:
    what = "Evaluation" if all(each.is_evaluation for each in found) else "Recordings"
    names = list(dict.fromkeys(task.summary.task for task in tasks))
    if len(names) == 1:
        return f"{what}: {names[0]}"
    return f"{what}: {len(tasks)} tasks" if names else what

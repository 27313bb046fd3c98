# SPDX-License-Identifier: Apache-2.0
"""The contents of a report, which `gathering` collects and `page` shows.

All strings may come from untrusted files. Code that writes these strings into a page
must escape them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..evaluation.result_tables import ROW
from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import (
    AcrossTasks,
    TaskSummary,
    default_score_range,
    summarize_task,
)
from ..results.episodes import Episode

# An episode's outcome is this value, or a sum of 1 (terminated) and 2 (truncated).
FAILED: Final = 4

ROLES: Final = ("best", "median", "worst")

# The end of 1979. gym 0.21 and 0.22 counted seconds from an arbitrary moment.
_EARLIEST: Final = 315_532_800.0
_NO_MONITOR: Final = -2


@dataclass(kw_only=True)
class ReportVideo:
    """A video in the gallery.

    Attributes:
        path: the recorded file.
        infix: the infix of the monitor that recorded the video.
        episode_id: the number, in its monitor, of the video's episode. None if it shows
            several episodes, or if the number is unknown.
        index: the index of that episode in `ReportTask.episodes`; None if unknown.
        file: the address of the copy relative to the page, or a `data:` URL; empty if
            the video is not part of the report.
        image: a still image, as a JPEG; None if there is none.
        poster: the address of the still image, in the same form as `file`.
        roles: the roles of its episode: `"best"`, `"median"`, `"worst"`.
        height: height of the frames in pixels; None if unknown.
        width: width of the frames in pixels; None if unknown.
        seconds: duration in seconds; None if unknown.
        camera: a description of the camera; None if unknown.
        renderer: the OpenGL renderer that drew the video; None if unknown.
        sha256: the SHA-256 of the file; None if the metadata lacks it.
        command: the shell command that rerenders it; None without recorded states.
        notes: remarks, for example that the video is incomplete.
        trajectory: the file with the recorded states; None if there are none.
        replay: the address of the 3D page, relative to the report's page; empty if
            there is none.
    """

    path: Path
    infix: str = ""
    episode_id: int | None = None
    index: int | None = None
    file: str = ""
    image: bytes | None = None
    poster: str = ""
    roles: Sequence[str] = ()
    height: int | None = None
    width: int | None = None
    seconds: float | None = None
    camera: str | None = None
    renderer: str | None = None
    sha256: str | None = None
    command: str | None = None
    notes: list[str] = field(default_factory=list)
    trajectory: Path | None = None
    replay: str = ""


@dataclass(kw_only=True)
class ReportTask:
    """A task in an evaluation, or an environment in a monitor directory.

    Attributes:
        name: the task's name on the page, followed by the directory if several tasks
            have the same name.
        source: the directory, as given.
        is_evaluation: whether the episodes are from an evaluation, whose runs are
            seeds. If not, they are from monitors, in order of time, as in training.
        summary: the summary of the episodes.
        episodes: `(n,)` of dtype `ROW`, so that a million episodes need little memory.
            For monitors, `seed` is the index into `runs`, and `start_time` is the end
            time.
        runs: the names of the runs if they are monitors.
        failures: the reasons why episodes failed, keyed by index.
        videos: the videos, in the order of their episodes.
        provenance: human-readable pairs of label and value: versions, GL renderer,
            policy, seeds, selection rule, protocol ...
    """

    name: str
    source: str
    is_evaluation: bool
    summary: TaskSummary
    episodes: NDArray[np.void]
    runs: Sequence[str] = ()
    failures: Mapping[int, str] = field(default_factory=dict)
    videos: Sequence[ReportVideo] = ()
    provenance: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A verdict on recordings from `mjrec verify --json`.

    Attributes:
        source: the path that was verified, and the file with the verdict.
        verdict: `PASS`, `PARTLY` or `FAIL`.
        counts: number of findings by outcome: recreated, within tolerance, believed,
            different.
        level: the verification level.
    """

    source: str
    verdict: str
    counts: Mapping[str, int]
    level: str


@dataclass(kw_only=True)
class ReportContents:
    """The contents of a report.

    Attributes:
        title: the page's title.
        tasks: the tasks, in the order used on the page.
        across: for each evaluation, the statistics across tasks, keyed by directory.
        bootstrap: the settings for the intervals.
        problems: sentences about items that could not be read or shown.
        verdicts: the verdicts from verifications.
    """

    title: str = ""
    tasks: list[ReportTask] = field(default_factory=list)
    across: dict[str, AcrossTasks] = field(default_factory=dict)
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    problems: list[str] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)

    @property
    def videos(self) -> list[ReportVideo]:
        """All videos, in the order of the tasks."""
        return [video for task in self.tasks for video in task.videos]


def rows_of_monitor(episodes: Iterable[Episode], *, run: int) -> NDArray[np.void]:
    """Return a monitor's episodes as rows.

    Args:
        episodes: the episodes, which are read one by one and not kept.
        run: the monitor's index.
    """

    def row(episode: Episode) -> tuple[float | None, ...]:
        number, truths = episode.episode_id, []
        for truth in (episode.terminated, episode.truncated, episode.success):
            truths.append(-1 if truth is None else int(truth))
        # An episode with an uncertain number has no files, so it gets no video.
        has_files = episode.video or episode.metadata or episode.trajectory
        figures = run, number, episode.reward, episode.length, *truths
        return *figures, episode.end_time, 0.0, run, number if has_files else -1

    return np.fromiter(map(row, episodes), ROW)


def in_time(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return monitors' episodes in the order in which they ended.

    Episodes that ended at the same time keep their order. Episodes without a time come
    last.
    """
    rows = rows[np.argsort(end_times(rows), kind="stable")]
    rows["start_time"][rows["start_time"] < _EARLIEST] = np.nan
    return rows


def end_times(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Return when episodes ended, in seconds since the epoch; NaN if unknown."""
    times: NDArray[np.float64] = rows["start_time"] + rows["seconds"]
    return times


def outcomes(task: ReportTask) -> NDArray[np.int64]:
    """Return the outcome of each episode; see `FAILED`."""
    terminated, truncated = (task.episodes[k] == 1 for k in ("terminated", "truncated"))
    found: NDArray[np.int64] = terminated + 2 * truncated
    found[list(task.failures)] = FAILED
    return found


def find_episodes(
    videos: Iterable[ReportVideo], rows: NDArray[np.void], monitors: Sequence[str]
) -> None:
    """Set the indices of the videos' episodes.

    Args:
        videos: the videos.
        rows: the episodes.
        monitors: the infixes of the monitors that recorded the episodes.
    """
    number = {infix: index for index, infix in enumerate(monitors)}
    for video in videos:
        of_monitor = rows["monitor"] == number.get(video.infix, _NO_MONITOR)
        [found] = np.nonzero(of_monitor & (rows["episode_id"] == video.episode_id))
        video.index = int(found[0]) if len(found) else None


def summary_of_rows(
    name: str, rows: NDArray[np.void], *, bootstrap: Bootstrap
) -> TaskSummary:
    """Return the summary of episodes that monitors recorded, excluding failed ones.

    Args:
        name: the environment's name.
        rows: the episodes.
        bootstrap: settings for the intervals.
    """
    success = rows["success"]
    return summarize_task(
        name,
        total_rewards=rows["total_reward"],
        runs=len(np.unique(rows["seed"])),
        lengths=rows["length"],
        terminated=rows["terminated"] == 1,
        truncated=rows["truncated"] == 1,
        success=np.where(success < 0, np.nan, success),
        score_range=default_score_range(name),
        bootstrap=bootstrap,
    )


def episodes_with_roles(task: ReportTask) -> dict[int, tuple[str, ...]]:
    """Return the roles of the best, median and worst episodes, keyed by index.

    Ties go to the first episode. For an even number of episodes, the median is the
    lower one. NaN is the worst return. Failed episodes have no role.
    """
    completed = np.delete(np.arange(len(task.episodes)), list(task.failures))
    if not len(completed):
        return {}
    returns = task.episodes["total_reward"][completed]
    is_number = ~np.isnan(returns)
    values = np.where(is_number, returns, 0.0)
    # NaNs come first.
    ordered = np.lexsort((values, is_number))
    middle = ordered[(len(ordered) - 1) // 2]
    roles: dict[int, tuple[str, ...]] = {}
    for role, one in zip(ROLES, (ordered[-1], middle, ordered[0]), strict=True):
        alike = (values == values[one]) & (is_number == is_number[one])
        index = int(completed[np.argmax(alike)])
        roles[index] = (*roles.get(index, ()), role)
    return roles

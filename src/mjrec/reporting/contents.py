# SPDX-License-Identifier: Apache-2.0
"""What a report shows, gathered: what `page` makes a page of.

All text may come from files of strangers; whoever writes it into a page escapes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import AcrossTasks, TaskSummary


@dataclass(frozen=True, kw_only=True)
class EpisodeColumns:
    """The episodes of one task in order: a million of them fit into little memory.

    Attributes:
        run: `(n,) int64`, the seed of an evaluation; else the monitor, as an index
            into `runs`.
        runs: what the runs are called where they are monitors; None where they are
            seeds.
        episode: `(n,) int64`, the number in its run.
        total_reward: `(n,) float64`, NaN where it failed.
        length: `(n,) int64`, steps.
        end_time: `(n,) float64`, wall clock, seconds; NaN where it is not known.
        outcome: `(n,) uint8`: 0 unknown, 1 terminated, 2 truncated, 3 both, 4 failed.
        success: `(n,) int8`: 1, 0, or -1 where nothing is known.
        failures: the reasons, by index, of those that failed.
        videos: index into `ReportContents.videos`, by index, of those that have one.
    """

    run: NDArray[np.int64]
    runs: Sequence[str] | None
    episode: NDArray[np.int64]
    total_reward: NDArray[np.float64]
    length: NDArray[np.int64]
    end_time: NDArray[np.float64]
    outcome: NDArray[np.uint8]
    success: NDArray[np.int8]
    failures: Mapping[int, str] = field(default_factory=dict)
    videos: Mapping[int, Sequence[int]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ReportTask:
    """One task, or one environment of a monitor directory, of one of the directories.

    Attributes:
        name: what it is called on the page; with its directory where others have the
            same environment.
        source: the directory, as it was given.
        is_evaluation: the episodes are those of an evaluation, whose runs are seeds;
            else of monitors, in the order of time, as of a training.
        summary: of its episodes.
        episodes: all of them.
        provenance: label and value, for people: versions, GL renderer, policy, seeds,
            selection rule, protocol ...
    """

    name: str
    source: str
    is_evaluation: bool
    summary: TaskSummary
    episodes: EpisodeColumns
    provenance: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True, kw_only=True)
class ReportVideo:
    """A video of the gallery.

    Attributes:
        task: index into `ReportContents.tasks`.
        index: of its episode in the task's columns; None where it is not known.
        file: its path relative to the page, or a `data:` URL; empty where it is not
            part of the report.
        poster: likewise, of a picture of it; None where there is none.
        name: the base name of the video in its monitor directory.
        roles: which of `"best"`, `"median"`, `"worst"` its episode is among the
            completed episodes of its task.
        height: of its pictures, in pixels; None where it is not known.
        width: likewise.
        seconds: how long it plays; None where it is not known.
        camera: what it was seen from; None where it is not known.
        sha256: of the file; None where the metadata does not say.
        command: the shell command that renders it again; None where there is no
            recorded state.
        notes: what else is to be said, such as that it is incomplete.
    """

    task: int
    index: int | None
    file: str
    poster: str | None
    name: str
    roles: Sequence[str] = ()
    height: int | None = None
    width: int | None = None
    seconds: float | None = None
    camera: str | None = None
    sha256: str | None = None
    command: str | None = None
    notes: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What `mjrec verify --json` said of recordings.

    Attributes:
        source: what was verified, and which file says so.
        passed: whether nothing failed.
        counts: how many checks passed, failed and were not checkable, by verdict.
        level: how deep it went.
    """

    source: str
    passed: bool
    counts: Mapping[str, int]
    level: str


@dataclass(frozen=True, kw_only=True)
class ReportContents:
    """All of a report.

    Attributes:
        title: of the page.
        tasks: in the order of the page.
        videos: of all tasks.
        across: what is said of all tasks together, one for each evaluation, by the
            directory's name; empty where there is none.
        bootstrap: how intervals were made.
        problems: what could not be read or shown, in sentences.
        verdicts: of verifications.
        made_with: versions, for the page's foot.
    """

    title: str
    tasks: Sequence[ReportTask]
    videos: Sequence[ReportVideo] = ()
    across: Mapping[str, AcrossTasks] = field(default_factory=dict)
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    problems: Sequence[str] = ()
    verdicts: Sequence[Verdict] = ()
    made_with: Mapping[str, Any] = field(default_factory=dict)

# SPDX-License-Identifier: Apache-2.0
"""What a report shows: `gathering` finds it, `media` copies videos, `page` shows it.

All text may come from files of strangers; whatever writes it into a page escapes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..evaluation.statistics import Bootstrap
from ..evaluation.summaries import AcrossTasks, TaskSummary

# One episode: a million of them fit into little memory. `run` is the seed of an
# evaluation, else the monitor, as an index into `ReportTask.runs`; `total_reward` and
# `end_time` (wall clock, seconds) are NaN where they are not known; `outcome` is a sum
# of the numbers below; `success` is 1, 0, or -1 where nothing is known.
EPISODE: Final = np.dtype(
    [
        ("run", "i8"),
        ("episode", "i8"),
        ("total_reward", "f8"),
        ("length", "i8"),
        ("end_time", "f8"),
        ("outcome", "u1"),
        ("success", "i1"),
    ]
)
TERMINATED: Final = 1
TRUNCATED: Final = 2
FAILED: Final = 4


@dataclass(kw_only=True)
class ReportVideo:
    """A video of the gallery.

    Attributes:
        path: of the recorded file.
        infix: of the monitor that recorded it.
        episode_id: the number, in its monitor, of the one episode that it shows; None
            where it shows several, or it is not known which.
        index: of that episode in `ReportTask.episodes`; None where it is not known.
        file: its address relative to the page, or a `data:` URL; empty where it is not
            part of the report.
        poster: likewise, of an image of it; empty where there is none.
        roles: which of `"best"`, `"median"`, `"worst"` its episode is.
        height: of the frames in pixels; None where it is not known.
        width: likewise.
        seconds: how long it plays; None where it is not known.
        camera: what it was seen from; None where it is not known.
        renderer: what OpenGL drew it with; None where it is not known.
        sha256: of the file; None where the metadata does not say.
        command: the shell command that renders it again; None where there is no
            recorded state.
        notes: what else is to be said, such as that it is incomplete.
        trajectory: of the recorded states; None where there are none.
        replay: the address of its page in 3D, relative to this one; empty without.
    """

    path: Path
    infix: str = ""
    episode_id: int | None = None
    index: int | None = None
    file: str = ""
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
    """One task, or one environment of a monitor directory, of one of the directories.

    Attributes:
        name: what it is called on the page; with its directory where others have the
            same environment.
        source: the directory, as it was given.
        is_evaluation: the episodes are those of an evaluation, whose runs are seeds;
            else of monitors, in the order of time, as of a training.
        summary: of its episodes.
        episodes: `(n,)` of dtype `EPISODE`.
        runs: what the runs are called where they are monitors.
        failures: the reasons, by index, of the episodes that failed.
        videos: in the order of their episodes.
        provenance: label and value, for people: versions, GL renderer, policy, seeds,
            selection rule, protocol ...
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
    """What `mjrec verify --json` said of recordings.

    Attributes:
        source: what was verified, and which file says so.
        verdict: `PASS`, `PARTLY` or `FAIL`.
        counts: how many findings say recreated, within tolerance, believed, different.
        level: how deep it went.
    """

    source: str
    verdict: str
    counts: Mapping[str, int]
    level: str


@dataclass(kw_only=True)
class ReportContents:
    """All of a report.

    Attributes:
        title: of the page.
        tasks: in the order of the page.
        across: what is said of all tasks together, one for each evaluation, by the
            directory's name; empty where there is none.
        bootstrap: how intervals were made.
        problems: what could not be read or shown, in sentences.
        verdicts: of verifications.
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

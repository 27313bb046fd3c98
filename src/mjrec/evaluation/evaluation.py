# SPDX-License-Identifier: Apache-2.0
"""What an evaluation comes to, and how far it is."""

from __future__ import annotations

import functools
import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..formats.monitor_directory import Infix, trajectory_prefix, video_prefix
from ..formats.notebook import shown
from .episode_results import EpisodeResult
from .plan import EvaluationPlan
from .result_tables import EpisodeFiles
from .results_files import ChosenEpisode
from .statistics import Bootstrap, Interval
from .summaries import AcrossTasks, TaskSummary


@dataclass(frozen=True, kw_only=True)
class EvaluationProgress:
    """How far an evaluation is.

    Attributes:
        done: how many episodes are over, failed ones too, and those that were done
            when it was resumed.
        failed: how many of them failed.
        total: how many there are.
        videos_done: how many videos are over.
        videos: how many there are, as far as is known.
        frames_done: how many frames of these videos are drawn; 0 where the workers of
            an engine draw.
        frames: how many frames these videos have; likewise.
    """

    done: int = 0
    failed: int = 0
    total: int = 0
    videos_done: int = 0
    videos: int = 0
    frames_done: int = 0
    frames: int = 0


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What an evaluation came to; the same stands in its directory.

    Attributes:
        directory: of the evaluation.
        plan: what was evaluated.
        results: of every episode, in the order of the plan.
        summaries: of the tasks, in the order of the plan.
        across: what is said of all tasks that have a scale.
        bootstrap: how intervals were made.
        selection: which episodes were chosen to get a video, by task.
        videos: those that are there.
        pending: why videos that were chosen are not there, by the path they will have.
    """

    directory: Path
    plan: EvaluationPlan
    results: Sequence[EpisodeResult]
    summaries: Sequence[TaskSummary]
    across: AcrossTasks
    bootstrap: Bootstrap
    selection: Mapping[str, Sequence[ChosenEpisode]]
    videos: Sequence[Path] = ()
    pending: Mapping[Path, str] = field(default_factory=dict)

    def _repr_html_(self) -> str:
        """Show the evaluation in a notebook: a row per task, and the chosen videos."""
        facts = {"episodes": len(self.results), "directory": self.directory}
        level = f"{100 * self.bootstrap.confidence:g} %"
        columns = ("task", "episodes", "mean", level, "IQM", "success", "failed")
        rows = [
            (
                *(each.task, each.episodes, each.mean, _extent(each.mean_interval)),
                *(each.iqm, each.success_rate, each.failed),
            )
            for each in self.summaries
        ]
        return shown("Evaluation", facts, self.videos, columns=columns, rows=rows)

    @property
    def failed(self) -> Sequence[EpisodeResult]:
        """The episodes that could not be completed."""
        return [each for each in self.results if each.failure is not None]

    @property
    def not_finite(self) -> Sequence[EpisodeResult]:
        """The completed episodes whose return is NaN or infinite."""
        returns = ((each, each.total_reward) for each in self.results)
        return [each for each, r in returns if r is not None and not math.isfinite(r)]

    def folder_of(self, result: EpisodeResult) -> Path:
        """Return the monitor directory that an episode was recorded into."""
        (folder,) = (t.folder for t in self.plan.tasks if t.name == result.task)
        chunk = self.plan.chunk_of(result.unit)
        return self.directory / folder / ("" if chunk is None else chunk.folder)

    def file_of(self, result: EpisodeResult) -> Path | None:
        """Return the video of an episode, or its trajectory where there is none."""
        names = self.files_of(result, None)
        folder = self.folder_of(result)
        paths = [folder / each for each in (names.video, names.trajectory) if each]
        return next((path for path in paths if path.exists()), None)

    def files_of(
        self, result: EpisodeResult, names: Container[str] | None
    ) -> EpisodeFiles:
        """Return which files are an episode's.

        Args:
            result: the episode.
            names: of all files in its folder; None is any that it may have.
        """
        infix = Infix.parse(result.monitor or "")
        if infix is None or result.episode_id is None:
            return EpisodeFiles()
        trajectory = f"{trajectory_prefix(infix, result.episode_id)}.h5"
        prefix = video_prefix(infix, result.episode_id)
        chosen = self._chosen.get(result.task, ())
        video = f"{prefix}.mp4"
        if names is not None:
            # Text is recorded as such.
            text = f"{prefix}.json"
            is_chosen = result.unit in chosen
            video = text if text in names else video if is_chosen else ""
            trajectory = trajectory if trajectory in names else ""
        return EpisodeFiles(
            folder=self.folder_of(result).relative_to(self.directory).as_posix(),
            trajectory=trajectory or None,
            video=video or None,
        )

    @functools.cached_property
    def _chosen(self) -> Mapping[str, set[tuple[int, int]]]:
        return {
            task: {(each.seed, each.episode) for each in chosen}
            for task, chosen in self.selection.items()
        }

    def summary(self, task: str) -> TaskSummary:
        """Return what is said of one task.

        Raises:
            KeyError: it was not evaluated.
        """
        return {each.task: each for each in self.summaries}[task]


def _extent(interval: Interval | None) -> str:
    return f"{interval.low:.4g} to {interval.high:.4g}" if interval else ""

# SPDX-License-Identifier: Apache-2.0
"""What an evaluation comes to, and how far it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from .episode_results import EpisodeResult
from .plan import EvaluationPlan
from .results_files import ChosenEpisode
from .statistics import Bootstrap
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
        frames_done: how many frames of the present task's videos are drawn; 0 where
            the workers of an engine draw.
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

    @property
    def failed(self) -> Sequence[EpisodeResult]:
        """The episodes that could not be completed."""
        return [each for each in self.results if each.failure is not None]

    def summary(self, task: str) -> TaskSummary:
        """Return what is said of one task.

        Raises:
            KeyError: it was not evaluated.
        """
        return {each.task: each for each in self.summaries}[task]

# SPDX-License-Identifier: Apache-2.0
"""Drawing the videos of the episodes of an evaluation that were chosen."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..rendering.finish import bring_up_to_date, finish
from ..rendering.jobs import Progress, RecordingKey
from .evaluation import EvaluationProgress
from .following import TaskRun, not_drawn

logger = logging.getLogger(__name__)


@dataclass
class ChosenVideos:
    """The videos of the chosen episodes.

    Attributes:
        there: those that are there.
        pending: why the others are not, by the path that they will have.
    """

    there: list[Path] = field(default_factory=list)
    pending: dict[Path, str] = field(default_factory=dict)


def render_chosen(
    directory: Path,
    runs: Sequence[TaskRun],
    *,
    workers: int,
    over: EvaluationProgress,
    tell: Callable[[EvaluationProgress], object],
) -> ChosenVideos:
    """Draw what is pending of the chosen episodes. What cannot be drawn stays pending.

    Args:
        directory: of the evaluation.
        runs: its tasks, settled.
        workers: how many processes draw.
        over: how far the evaluation is without the videos.
        tell: is told how far it is.
    """
    videos = ChosenVideos()
    keys = {of.task.folder: of.chosen_keys for of in runs}
    total = sum(map(len, keys.values()))
    before = 0
    for of in runs:
        folder = directory / of.task.folder

        def show(progress: Progress, before: int = before) -> None:
            tell(
                replace(
                    over,
                    videos_done=before + progress.videos_done,
                    videos=total,
                    frames_done=progress.frames_done,
                    frames=progress.frames or 0,
                )
            )

        if keys[of.task.folder]:
            reasons = _render(folder, keys[of.task.folder], workers, show)
            _sort(videos, folder, keys[of.task.folder], reasons, of.problem)
        before += len(keys[of.task.folder])
    return videos


def drawn_by_workers(directory: Path, runs: Sequence[TaskRun]) -> ChosenVideos:
    """Return what came of the chosen episodes, which the workers have drawn.

    Args:
        directory: of the evaluation.
        runs: its tasks, of which every video is over.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    videos = ChosenVideos()
    for of in runs:
        folder = directory / of.task.folder
        if of.chosen_keys:
            bring_up_to_date(folder)
            reasons = _told(folder, of.not_drawn)
            _sort(videos, folder, of.chosen_keys, reasons, of.problem)
    return videos


def _render(
    folder: Path,
    keys: Sequence[RecordingKey],
    workers: int,
    show: Callable[[Progress], object],
) -> dict[str, str]:
    """Return why videos are not there, or show nothing, by their names."""
    reasons: dict[str, str] = {}
    for result in finish(folder, keys, workers=workers, on_progress=show):
        reasons |= not_drawn(result)
    return _told(folder, reasons)


def _told(folder: Path, reasons: Mapping[str, str]) -> dict[str, str]:
    """Log why videos are not there; return it with what is to be done."""
    for reason in dict.fromkeys(reasons.values()):
        names = [name for name in reasons if reasons[name] == reason]
        logger.warning(
            "%s in %s: %s %s",
            ", ".join(names),
            folder,
            reason,
            _again(folder),
        )
    return {name: f"{reason} {_again(folder)}" for name, reason in reasons.items()}


def _again(folder: Path) -> str:
    return f"To try again: mjrec render {folder}"


def _sort(
    videos: ChosenVideos,
    folder: Path,
    keys: Sequence[RecordingKey],
    reasons: Mapping[str, str],
    problem: str | None,
) -> None:
    for key in keys:
        path = folder / key.video_name
        # Text is recorded as such.
        there = [each for each in (path, path.with_suffix(".json")) if each.exists()]
        if there:
            videos.there.append(there[0])
        else:
            why = reasons.get(path.name) or problem or _not_promised(folder, key)
            videos.pending[path] = why


def _not_promised(folder: Path, key: RecordingKey) -> str:
    return (
        "It was not among the chosen when its recording was settled, before more was "
        f"asked for. To draw it: mjrec render {folder / key.name}.h5 "
        "--out VIDEO.mp4"
    )

# SPDX-License-Identifier: Apache-2.0
"""Handing out an evaluation, and following it until every episode is over.

Chunks are handed out, and as soon as all episodes of a task are over, those that get a
video are chosen, while other tasks still run. Where the workers draw, too, its videos
come next. What was done is read from the journals of the chunks.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..engines.jobs import JobOutcome, Run
from ..errors import EnvironmentNotMade, Error
from ..formats.monitor_directory import Infix
from ..messages import unpacked
from ..rendering.engine_jobs import result_of
from ..rendering.finish import bring_up_to_date
from ..rendering.finisher import do_jobs
from ..rendering.jobs import Progress, RecordingKey, RenderedVideos, VideoJob
from ..simulation.model_trust import note_models
from .choosing import write_choice
from .chunk_results import ChunkResults, read_chunk
from .episode_results import EpisodeResult
from .evaluation import EvaluationProgress
from .kept_episodes import Chosen, keep_rule
from .plan import Chunk, EvaluatedTask, EvaluationPlan, Unit

logger = logging.getLogger(__name__)

# How often progress is reported, and the most of the time that counting it takes.
_SECONDS_BETWEEN_REPORTS = 0.25
_MOST_OF_TIME = 0.05

_Tell = Callable[[EvaluationProgress], object]


@dataclass
class ChunkRun:
    """A chunk of a task while it is run.

    Attributes:
        chunk: which one.
        folder: its monitor directory.
        known: what is done of it.
        rounds: how often it was handed out.
        size: how much was done of it when it was handed out last.
        models: hashes of the compiled models that workers stored.
        is_over: nothing more comes.
    """

    chunk: Chunk
    folder: Path
    known: ChunkResults
    rounds: int = 0
    size: int = 0
    models: Sequence[str] = ()
    is_over: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether all of its episodes have ended."""
        return all(unit in self.known.results for unit in self.chunk)


@dataclass(frozen=True)
class ChosenVideo:
    """A video that an episode was chosen to get.

    Attributes:
        folder: the chunk's monitor directory.
        key: the recording.
        models: hashes of the compiled models that it may need.
    """

    folder: Path
    key: RecordingKey
    models: Sequence[str]

    @property
    def path(self) -> Path:
        """Where the video is, or will be. Text is recorded as such."""
        path = self.folder / self.key.video_name
        as_text = path.with_suffix(".json")
        return as_text if as_text.exists() else path


@dataclass
class TaskRun:
    """A task while it is evaluated, and then its results.

    Attributes:
        task: which one.
        chunks: of its episodes, by their folders' names.
        results: of all its episodes, in the order of the plan, when they are over.
        chosen: of those, which get a video, each with its role.
        videos: of the chosen episodes, each once.
        reasons: why episodes have no result, by chunk.
    """

    task: EvaluatedTask
    chunks: dict[str, ChunkRun]
    results: list[EpisodeResult] = field(default_factory=list)
    chosen: list[Chosen] = field(default_factory=list)
    videos: list[ChosenVideo] = field(default_factory=list)
    reasons: dict[str, str] = field(default_factory=dict)


def check_tasks(
    run: Run, plan: EvaluationPlan, tasks: Sequence[EvaluatedTask]
) -> dict[str, Mapping[str, Any]]:
    """Let workers make the environment and the policy of each task, and no step.

    Returns:
        What they say of each, by name; `worker` says what that is.

    Raises:
        Error: the one that making them raised, such as an `UnknownName`.
    """
    names = {f"check/{task.folder}": task.name for task in tasks}
    for key, name in names.items():
        run.submit(key, kind="check", task=name)
    checked: dict[str, Mapping[str, Any]] = {}
    for outcome in run.results():
        # Without patience there is always one.
        assert outcome is not None
        name = names[outcome.key]
        if outcome.failure is not None:
            # No error of ours, which would have been carried: its worker died.
            raise EnvironmentNotMade(name, outcome.failure)
        said = outcome.value or {}
        if "error" in said:
            raise unpacked(said["error"])
        checked[name] = said
    return checked


class Runner:
    """Runs one evaluation.

    Args:
        run: its workers.
        plan: what is evaluated.
        directory: of the evaluation.
        draws: whether the workers draw the chosen videos, too.
        on_results: called once, with the tasks, when all episodes are over: what is
            left then are videos.
        tell: called with how far it is.

    Attributes:
        tasks: of the plan.
        not_drawn: why videos could not be drawn, by their paths.
    """

    def __init__(
        self,
        run: Run,
        plan: EvaluationPlan,
        directory: Path,
        *,
        draws: bool,
        on_results: Callable[[Sequence[TaskRun]], object],
        tell: _Tell,
    ) -> None:
        self._run = run
        self._plan = plan
        self._directory = directory
        self._draws = draws
        self._on_results = on_results
        self._tell = tell
        self.tasks = tasks_in(directory, plan)
        self.not_drawn: dict[Path, str] = {}
        self._by_key: dict[str, tuple[TaskRun, ChunkRun]] = {}
        self._videos: dict[str, ChosenVideo] = {}
        self._progress = EvaluationProgress()
        self._counts_from = 0.0

    def run(self, velocities: Mapping[str, int]) -> None:
        """Run all that is not done, and draw where the workers do.

        Args:
            velocities: of each task's simulation: how much work a step is, roughly.

        Raises:
            Error: workers cannot be started, or a journal is damaged.
        """
        # What takes long comes first, so that all workers end at about the same time.
        for of in sorted(self.tasks, key=lambda of: -velocities.get(of.task.name, 0)):
            for each in of.chunks.values():
                each.is_over = each.is_complete
                if not each.is_over:
                    self._submit(of, each)
        for of in self.tasks:
            self._complete_if_over(of)
        for outcome in self._run.results(patience_s=_SECONDS_BETWEEN_REPORTS):
            if outcome is not None and outcome.key in self._videos:
                self._take_video(outcome)
            elif outcome is not None:
                self._take_chunk(outcome)
            self._report()

    def draw(self, *, workers: int) -> None:
        """Draw the chosen videos with processes of this one."""
        videos = [video for of in self.tasks for video in of.videos]
        jobs = [VideoJob.finishing(each.folder, each.key) for each in videos]

        def show(progress: Progress) -> None:
            self._tell(
                dataclasses.replace(
                    self._progress,
                    videos_done=progress.videos_done,
                    videos=progress.videos,
                    frames_done=progress.frames_done,
                    frames=progress.frames or 0,
                )
            )

        for result in do_jobs(jobs, self._directory, workers=workers, on_progress=show):
            self._note_not_drawn(result)
        for folder in dict.fromkeys(each.folder for each in videos):
            bring_up_to_date(folder)

    def _submit(self, of: TaskRun, each: ChunkRun) -> None:
        each.rounds += 1
        each.size = _size(each.known)
        folder = f"{of.task.folder}/{each.chunk.folder}"
        key = f"run/{folder}/{each.rounds}"
        self._by_key[key] = of, each
        chunk = dataclasses.asdict(each.chunk)
        self._run.submit(key, kind="run", task=of.task.name, folder=folder, chunk=chunk)

    def _take_chunk(self, outcome: JobOutcome) -> None:
        of, each = self._by_key.pop(outcome.key)
        each.known = read_chunk(each.folder, of.task.name)
        # This user's, though it was done elsewhere: by workers of this process.
        each.models = (outcome.value or {}).get("models", ())
        note_models(each.models)
        if not each.is_complete:
            if _size(each.known) > each.size:
                # It came nearer to its end, and a poisoned episode fails alone.
                self._submit(of, each)
                return
            said = outcome.failure or (
                f"A worker has done {each.folder}, and what it recorded is not there: "
                "all machines must see the directory under the same name."
            )
            logger.warning("%s", said)
            why = said.partition(" The end of what it said")[0]
            of.reasons[each.chunk.folder] = why
        each.is_over = True
        self._complete_if_over(of)

    def _complete_if_over(self, of: TaskRun) -> None:
        """Choose among the episodes of a task, if all are over."""
        if not all(each.is_over for each in of.chunks.values()):
            return
        of.results = [self._result(of, unit) for unit in self._plan]
        of.chosen = keep_rule(self._plan.keep).choose(of.results)
        self._choose(of)
        if self._draws:
            for video in of.videos:
                key = f"draw/{video.path.relative_to(self._directory)}"
                self._videos[key] = video
                folder = str(video.folder.relative_to(self._directory))
                self._run.submit(
                    key,
                    kind="draw",
                    folder=folder,
                    models=video.models,
                    recording=video.key.told_name,
                )
        if all(each.results for each in self.tasks):
            self._on_results(self.tasks)

    def _result(self, of: TaskRun, unit: Unit) -> EpisodeResult:
        chunk = self._plan.chunk_of(unit)
        assert chunk is not None
        result = of.chunks[chunk.folder].known.results.get(unit)
        return result or EpisodeResult(
            task=of.task.name,
            seed=unit[0],
            episode=unit[1],
            total_reward=None,
            length=0,
            terminated=None,
            truncated=None,
            failure=of.reasons.get(chunk.folder, "nothing is known of it"),
        )

    def _choose(self, of: TaskRun) -> None:
        """Write down which episodes of a task get a video, where they were recorded."""
        chosen: dict[str, dict[RecordingKey, list[str]]] = {}
        for result, role in of.chosen:
            chunk = self._plan.chunk_of(result.unit)
            infix = Infix.parse(result.monitor or "")
            if chunk and infix and result.episode_id is not None:
                key = RecordingKey(infix, result.episode_id)
                chosen.setdefault(chunk.folder, {}).setdefault(key, []).append(role)
        for name, each in of.chunks.items():
            own = chosen.get(name, {})
            if not own and not each.known.is_drawn_live:
                continue
            keys = set(own)
            try:
                keys = write_choice(
                    each.folder, own, rule=self._plan.keep, finished=len(of.results)
                )
            except Error as error:
                logger.warning("The videos of %s cannot be chosen: %s", name, error)
                for key in own:
                    self.not_drawn[each.folder / key.video_name] = str(error)
            of.videos += [
                ChosenVideo(each.folder, key, each.models) for key in own if key in keys
            ]

    def _take_video(self, outcome: JobOutcome) -> None:
        video = self._videos[outcome.key]
        job = VideoJob.finishing(video.folder, video.key)
        self._note_not_drawn(result_of(outcome, job))
        bring_up_to_date(video.folder)
        done = self._progress.videos_done + 1
        self._progress = dataclasses.replace(self._progress, videos_done=done)

    def _note_not_drawn(self, result: RenderedVideos) -> None:
        elsewhere = dict.fromkeys(result.elsewhere, "Another process is drawing it.")
        for name, why in {**result.failures, **result.blank, **elsewhere}.items():
            self.not_drawn[result.directory / name] = why

    def _report(self) -> None:
        now = time.monotonic()
        is_over = not self._by_key
        if now < self._counts_from and not is_over:
            return
        runs = [each for of in self.tasks for each in of.chunks.values()]
        for of in self.tasks:
            for each in of.chunks.values():
                if not each.is_over and each.folder.exists():
                    each.known = read_chunk(each.folder, of.task.name)
        results = [result for each in runs for result in each.known.results.values()]
        self._progress = dataclasses.replace(
            self._progress,
            done=len(results),
            failed=sum(result.failure is not None for result in results),
            total=sum(len(each.chunk) for each in runs),
            videos=len(self._videos),
        )
        self._counts_from = now + (time.monotonic() - now) / _MOST_OF_TIME
        self._tell(self._progress)


def tasks_in(directory: Path, plan: EvaluationPlan) -> list[TaskRun]:
    """Return the tasks of an evaluation, with what is done of them."""
    return [
        TaskRun(
            task,
            {
                chunk.folder: ChunkRun(
                    chunk,
                    folder := directory / task.folder / chunk.folder,
                    read_chunk(folder, task.name),
                )
                for chunk in plan.chunks
            },
        )
        for task in plan.tasks
    ]


def _size(known: ChunkResults) -> int:
    return len(known.results) + known.deaths.total()

# SPDX-License-Identifier: Apache-2.0
"""Distribution of an evaluation to workers, from its start to the drawn videos.

The results of episodes are read from the chunks' journals, never from the return values
of workers.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..engines.jobs import Run
from ..errors import EnvironmentNotMade, Error
from ..messages import unpacked
from ..recorder.keep_rules import keep_rule
from ..rendering.chosen_videos import write_choice
from ..rendering.finish import bring_up_to_date, do_jobs
from ..rendering.jobs import Progress, RecordingKey, VideoJob
from ..simulation.model_trust import note_models
from .chunk_results import ChunkResults, read_chunk
from .episode_results import EpisodeResult
from .evaluation import ChosenEpisode
from .plan import Chunk, EvaluatedTask, EvaluationPlan

logger = logging.getLogger(__name__)

# The number of seconds between progress reports, and the maximum share of the time that
# is spent on counting finished episodes.
_SECONDS_BETWEEN_REPORTS = 0.25
_MOST_OF_TIME = 0.05


@dataclass(frozen=True, kw_only=True)
class EvaluationProgress:
    """The progress of an evaluation.

    Attributes:
        done: number of finished episodes, including failed episodes and episodes that
            were finished before the evaluation was resumed.
        failed: number of failed episodes.
        total: total number of episodes.
        videos_done: number of finished videos.
        videos: total number of videos that are known so far.
        frames_done: number of frames drawn so far; 0 if an engine's workers draw the
            videos.
        frames: total number of frames in the videos; 0 if an engine's workers draw the
            videos.
    """

    done: int = 0
    failed: int = 0
    total: int = 0
    videos_done: int = 0
    videos: int = 0
    frames_done: int = 0
    frames: int = 0


_Tell = Callable[[EvaluationProgress], object]


@dataclass
class ChunkRun:
    """The current state of a chunk of a task.

    Attributes:
        task: the task.
        chunk: the chunk.
        folder: the chunk's monitor directory.
        known: the chunk's finished episodes, as last read.
        rounds: number of times that the chunk was submitted.
        size: value of `ChunkResults.size` when the chunk was last submitted.
        reason: the reason to give for episodes that have no result.
        is_over: whether the chunk will not produce any more results.
    """

    task: EvaluatedTask
    chunk: Chunk
    folder: Path
    known: ChunkResults
    rounds: int = 0
    size: int = 0
    reason: str = "its result is missing"
    is_over: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether all episodes of the chunk have a result."""
        return all(unit in self.known.results for unit in self.chunk)


@dataclass(frozen=True)
class Choice:
    """The episodes that get a video.

    Attributes:
        selection: the chosen episodes of each task.
        videos: the recordings to draw, without duplicates. Each is a pair of a chunk's
            monitor directory and the key of a recording in that directory.
        impossible: reasons why videos cannot be drawn, keyed by the videos' paths.
    """

    selection: Mapping[str, Sequence[ChosenEpisode]]
    videos: Sequence[tuple[Path, RecordingKey]]
    impossible: Mapping[Path, str]


def check_tasks(
    run: Run, plan: EvaluationPlan, *, workers: int = 1
) -> tuple[EvaluationPlan, Mapping[str, int]]:
    """Check that workers can create the environment and policy of each new task.

    The environments are not stepped.

    Args:
        run: the workers.
        plan: the plan of the evaluation.
        workers: number of workers to start if there are new tasks. Each worker has to
            create an environment sooner or later, so they all do it now, in parallel.

    Returns:
        The plan with the tasks' step limits, and for each new task a rough measure of
        the cost of a step.

    Raises:
        Error: an environment or policy could not be created. This is the original error
            from the worker, such as an `UnknownName`.
    """
    unknown = {task.name: task for task in plan.tasks if task.step_limit is None}
    if unknown:
        for number in range(max(len(unknown), workers)):
            name = [*unknown][number % len(unknown)]
            run.submit(f"{number}", kind="check", task=name)
    velocities: dict[str, int] = {}
    for outcome in run.results():
        # `outcome` is only None after a timeout, and none is set here.
        assert outcome is not None
        said = outcome.value or {}
        name = [*unknown][int(outcome.key) % len(unknown)]
        if outcome.failure is not None:
            # The worker must have died, because mjrec's errors are returned as "error".
            raise EnvironmentNotMade(name, outcome.failure)
        if "error" in said:
            raise unpacked(said["error"])
        limit = said["step_limit"]
        unknown[name] = dataclasses.replace(unknown[name], step_limit=limit)
        velocities[name] = said["velocities"]
    tasks = tuple(unknown.get(task.name, task) for task in plan.tasks)
    return dataclasses.replace(plan, tasks=tasks), velocities


def chunks_in(directory: Path, plan: EvaluationPlan) -> list[ChunkRun]:
    """Return the chunks of an evaluation, with their finished episodes."""
    return [
        ChunkRun(task, chunk, folder, read_chunk(folder, task.name))
        for task in plan.tasks
        for chunk in plan.chunks
        if (folder := directory / task.folder / chunk.folder)
    ]


def run_chunks(run: Run, chunks: Sequence[ChunkRun], tell: _Tell) -> EvaluationProgress:
    """Run the missing episodes of all chunks, and return the final progress.

    Args:
        run: the workers.
        chunks: the chunks, in the order of submission.
        tell: a function that is called with the progress.

    Raises:
        Error: workers cannot be started, or a journal is damaged.
    """
    by_key: dict[str, ChunkRun] = {}
    for each in chunks:
        each.is_over = each.is_complete
        if not each.is_over:
            by_key[_submit(run, each)] = each
    counts_from = 0.0
    progress = _progress(chunks)
    for outcome in run.results(timeout_s=_SECONDS_BETWEEN_REPORTS):
        if outcome is not None:
            each = by_key.pop(outcome.key)
            each.known = read_chunk(each.folder, each.task.name)
            # Models that this process's own workers stored can be trusted.
            note_models((outcome.value or {}).get("models", ()))
            if not each.is_complete and each.known.size > each.size:
                # There was progress, so the chunk is submitted again. An episode that
                # repeatedly kills its process eventually counts as failed.
                by_key[_submit(run, each)] = each
                continue
            each.is_over = True
            if not each.is_complete:
                said = outcome.failure or (
                    f"A worker finished {each.folder}, but the recordings are missing "
                    "there. All machines must see the directory under the same path."
                )
                logger.warning("%s", said)
                each.reason = said.partition(" Its last output")[0]
        now = time.monotonic()
        if now >= counts_from or not by_key:
            for each in chunks:
                if not each.is_over and each.folder.exists():
                    each.known = read_chunk(each.folder, each.task.name)
            progress = _progress(chunks)
            counts_from = now + (time.monotonic() - now) / _MOST_OF_TIME
            tell(progress)
    return progress


def results_of(plan: EvaluationPlan, chunks: Iterable[ChunkRun]) -> list[EpisodeResult]:
    """Return the results of all episodes, in the plan's order."""
    by_name = {(each.task.name, each.chunk.folder): each for each in chunks}
    results = []
    for task in plan.tasks:
        for unit in plan:
            chunk = plan.chunk_of(unit)
            assert chunk is not None
            of = by_name[task.name, chunk.folder]
            lost = EpisodeResult(
                task=task.name,
                seed=unit[0],
                episode=unit[1],
                total_reward=None,
                length=0,
                terminated=None,
                truncated=None,
                failure=of.reason,
            )
            results.append(of.known.results.get(unit, lost))
    return results


def choose_videos(
    plan: EvaluationPlan, chunks: Sequence[ChunkRun], results: Iterable[EpisodeResult]
) -> Choice:
    """Choose the episodes that get a video, and write the choice to the folders."""
    selection: dict[str, list[ChosenEpisode]] = {}
    videos: list[tuple[Path, RecordingKey]] = []
    impossible: dict[Path, str] = {}
    by_task: dict[str, list[EpisodeResult]] = {task.name: [] for task in plan.tasks}
    for result in results:
        by_task[result.task].append(result)
    for task, own in by_task.items():
        chosen: dict[str, dict[RecordingKey, list[ChosenEpisode]]] = {}
        # The order in which ties are broken must depend only on the episodes.
        own.sort(key=lambda each: each.unit)
        begun = [each if each.episode_id is not None else None for each in own]
        kept = keep_rule(plan.keep).choose(begun)
        for result, role in kept:
            chunk = plan.chunk_of(result.unit)
            if chunk and result.monitor and result.episode_id is not None:
                key = RecordingKey(result.monitor, result.episode_id)
                episode = ChosenEpisode(*result.unit, role)
                chosen.setdefault(chunk.folder, {}).setdefault(key, []).append(episode)
        drawable: set[ChosenEpisode] = set()
        for each in chunks:
            mine = chosen.get(each.chunk.folder, {}) if each.task.name == task else {}
            if each.task.name != task or not (mine or each.known.is_drawn_live):
                continue
            roles = {key: [e.role for e in mine[key]] for key in mine}
            try:
                keys = write_choice(
                    each.folder, roles, rule=plan.keep, finished=len(own)
                )
            except Error as error:
                logger.warning("%s: videos could not be chosen: %s", each.folder, error)
                keys = {*mine}
                impossible |= {each.folder / k.video_name: str(error) for k in keys}
            videos += [(each.folder, key) for key in mine if key in keys]
            drawable |= {e for key in mine if key in keys for e in mine[key]}
        # The episodes keep the order in which the rule returned them.
        selection[task] = [
            episode
            for result, role in kept
            if (episode := ChosenEpisode(*result.unit, role)) in drawable
        ]
    return Choice(selection, videos, impossible)


def draw_videos(
    choice: Choice,
    directory: Path,
    *,
    engine: Executor | None,
    workers: int,
    progress: EvaluationProgress,
    tell: _Tell,
) -> tuple[list[Path], dict[Path, str]]:
    """Draw the chosen videos.

    Args:
        choice: the chosen episodes.
        directory: the evaluation's directory.
        engine: the engine whose workers draw; None to draw in child processes.
        workers: number of child processes.
        progress: the progress of the episodes, which is included in each report.
        tell: a function that is called with the progress.

    Returns:
        The paths of the finished videos, and a mapping from the paths of the missing
        videos to the reasons why they are missing.
    """
    jobs = [
        VideoJob(directory=folder, recording=key.shown_name)
        for folder, key in choice.videos
    ]
    why = dict(choice.impossible)

    def show(now: Progress) -> None:
        tell(
            dataclasses.replace(
                progress,
                videos_done=now.videos_done,
                videos=now.videos,
                frames_done=now.frames_done,
                frames=now.frames or 0,
            )
        )

    for result in do_jobs(
        jobs, directory, workers=workers, engine=engine, on_progress=show
    ):
        elsewhere = dict.fromkeys(result.elsewhere, "Another process is drawing it.")
        for name, text in {**result.failures, **result.blank, **elsewhere}.items():
            why[result.directory / name] = text
    for folder in dict.fromkeys(folder for folder, _ in choice.videos):
        bring_up_to_date(folder)
    videos, pending = [], {}
    for folder, key in choice.videos:
        path = folder / key.video_name
        # Text environments have a text recording instead of a video.
        as_text = path.with_suffix(".json")
        path = as_text if as_text.exists() else path
        if path.exists():
            videos.append(path)
        else:
            text = why.get(path, "Its frames were not recorded.")
            pending[path] = f"{text} To try again, run: mjrec render {folder}"
    for reason in dict.fromkeys(pending.values()):
        names = [str(path) for path in pending if pending[path] == reason]
        logger.warning("%s: %s", ", ".join(names), reason)
    return videos, pending


def _submit(run: Run, each: ChunkRun) -> str:
    each.rounds += 1
    each.size = each.known.size
    folder = f"{each.task.folder}/{each.chunk.folder}"
    key = f"{folder}/{each.rounds}"
    chunk: dict[str, Any] = dataclasses.asdict(each.chunk)
    run.submit(key, kind="run", task=each.task.name, folder=folder, chunk=chunk)
    return key


def _progress(chunks: Iterable[ChunkRun]) -> EvaluationProgress:
    chunks = list(chunks)
    results = [result for each in chunks for result in each.known.results.values()]
    return EvaluationProgress(
        done=len(results),
        failed=sum(result.failure is not None for result in results),
        total=sum(len(each.chunk) for each in chunks),
    )

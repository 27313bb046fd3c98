# SPDX-License-Identifier: Apache-2.0
"""Distribution of an evaluation to workers, from the start to the finished videos.

The episodes' results are read from the chunks' journals, never from the workers' return
values.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from ..engines.jobs import Run
from ..errors import EnvironmentNotMade, Error
from ..formats.bundle import FINISHED, finished_trajectories
from ..formats.monitor_directory import iter_monitor_files
from ..messages import unpacked
from ..recorder.keep_rules import keep_rule
from ..rendering.chosen_videos import write_choice
from ..rendering.finish import bring_up_to_date, do_jobs
from ..rendering.jobs import Progress, RecordingKey, VideoJob
from ..rendering.recovery_needed import needs_recovery
from ..results.monitor_files import monitors_of
from ..simulation.model_trust import note_models
from .episode_results import ChunkResults, EpisodeResult, read_chunk
from .evaluation import ChosenEpisode, Evaluation
from .plan import Chunk, EvaluatedTask, EvaluationPlan, Unit
from .result_tables import EpisodeFiles

logger = logging.getLogger(__name__)

# The number of seconds between progress reports, and the maximum share of time spent on
# counting finished episodes.
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
        videos: total number of videos known so far.
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
    """The current state of a task's chunk.

    Attributes:
        task: the task.
        chunk: the chunk.
        folder: the chunk's monitor directory.
        known: the chunk's finished episodes, as last read.
        size: value of `ChunkResults.size` when the chunk was last submitted.
        reason: the reason reported for episodes that have no result.
    """

    task: EvaluatedTask
    chunk: Chunk
    folder: Path
    known: ChunkResults
    size: int = 0
    reason: str = "its result is missing"

    @property
    def place(self) -> str:
        """Path of the folder, relative to the evaluation's directory."""
        return f"{self.task.folder}/{self.chunk.folder}"

    @property
    def is_complete(self) -> bool:
        """Whether all episodes in the chunk have results."""
        return all(unit in self.known.results for unit in self.chunk)

    @property
    def is_finished(self) -> bool:
        """Whether the chunk is complete and its recordings are finished."""
        return self.is_complete and not any(
            needs_recovery(files) for files in monitors_of(self.folder)
        )

    def result(self, unit: Unit) -> EpisodeResult:
        """Return the result of an episode, or a failure if no result is known."""
        return self.known.results.get(unit) or EpisodeResult(
            task=self.task.name,
            seed=unit[0],
            episode=unit[1],
            total_reward=None,
            length=0,
            terminated=None,
            truncated=None,
            failure=self.reason,
        )


@dataclass(frozen=True)
class Choice:
    """The episodes chosen for videos.

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
    run: Run, plan: EvaluationPlan, names: Collection[str], *, workers: int = 1
) -> tuple[EvaluationPlan, Mapping[str, int]]:
    """Check that workers can create the environment and policy of each task to run.

    The environments are not stepped.

    Args:
        run: the workers.
        plan: the plan of the evaluation.
        names: the tasks to run.
        workers: number of workers to start if there are such tasks. Each worker must
            create an environment eventually, so all workers do so now, in parallel.

    Returns:
        The plan with the tasks' step limits and sources, and for each checked task, a
        rough measure of the cost of a step.

    Raises:
        Error: an environment or policy could not be created. This is the original error
            from the worker, such as an `UnknownName`.
    """
    checked = {task.name: task for task in plan.tasks if task.name in names}
    if checked:
        for number in range(max(len(checked), workers)):
            name = [*checked][number % len(checked)]
            run.submit(f"{number}", kind="check", task=name)
    velocities: dict[str, int] = {}
    sources = {**plan.sources}
    for outcome in run.results():
        # `outcome` is only None after a timeout, and none is set here.
        assert outcome is not None
        said = outcome.value or {}
        name = [*checked][int(outcome.key) % len(checked)]
        if outcome.failure is not None:
            # The worker must have died, because mjrec's errors are returned as "error".
            raise EnvironmentNotMade(name, outcome.failure)
        if "error" in said:
            raise unpacked(said["error"])
        limit = checked[name].step_limit or said["step_limit"]
        checked[name] = dataclasses.replace(checked[name], step_limit=limit)
        velocities[name] = said["velocities"]
        sources |= said["sources"]
    tasks = tuple(checked.get(task.name, task) for task in plan.tasks)
    # Sorted, because the outcomes come in any order.
    sources = dict(sorted(sources.items()))
    return dataclasses.replace(plan, tasks=tasks, sources=sources), velocities


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

    A killed process may have left a chunk with all results but unfinished recordings.
    Such a chunk is also submitted, because its job finishes the recordings.

    Args:
        run: the workers.
        chunks: the chunks, in the order of submission.
        tell: a function that is called with the progress.

    Raises:
        Error: workers cannot be started, or a journal is damaged.
    """
    by_key = {_submit(run, each): each for each in chunks if not each.is_finished}
    counts_from = 0.0
    progress = _progress(chunks)
    for outcome in run.results(timeout_s=_SECONDS_BETWEEN_REPORTS):
        if outcome is not None:
            each = by_key.pop(outcome.key)
            each.known = read_chunk(each.folder, each.task.name)
            # Models that this process's own workers stored can be trusted.
            note_models((outcome.value or {}).get("models", ()))
            if not each.is_complete and each.known.size > each.size:
                # There was progress, so the chunk is resubmitted. An episode that
                # repeatedly kills its process eventually counts as failed.
                by_key[_submit(run, each)] = each
                continue
            if outcome.failure or not each.is_complete:
                said = outcome.failure or (
                    f"A worker finished {each.folder}, but its recordings are missing "
                    "here. All machines must see the directory under the same path."
                )
                logger.warning("%s", said)
                each.reason = said.partition(" Its last output")[0]
        now = time.monotonic()
        if now >= counts_from or not by_key:
            for each in by_key.values():
                if each.folder.exists():
                    each.known = read_chunk(each.folder, each.task.name)
            progress = _progress(chunks)
            counts_from = now + (time.monotonic() - now) / _MOST_OF_TIME
            tell(progress)
    return progress


def results_of(
    plan: EvaluationPlan, chunks: Iterable[ChunkRun]
) -> dict[str, list[EpisodeResult]]:
    """Return the results of each task's episodes, in the plan's order."""
    # The chunks of a seed are in the order of their episodes.
    by_seed: dict[tuple[str, int], list[ChunkRun]] = {}
    for each in chunks:
        for seed in each.chunk.seeds:
            by_seed.setdefault((each.task.name, seed), []).append(each)
    return {
        task.name: [
            each.result((seed, number))
            for seed in plan.seeds
            for each in by_seed[task.name, seed]
            for number in range(each.chunk.first, each.chunk.stop)
        ]
        for task in plan.tasks
    }


def choose_videos(
    plan: EvaluationPlan,
    chunks: Sequence[ChunkRun],
    results: Mapping[str, Sequence[EpisodeResult]],
) -> Choice:
    """Choose the episodes for videos, and write the choice to the folders."""
    selection: dict[str, list[ChosenEpisode]] = {}
    videos: list[tuple[Path, RecordingKey]] = []
    impossible: dict[Path, str] = {}
    chunk_of = _by_monitor(chunks)
    for task, of_task in results.items():
        # The tie-breaking order must depend only on the episodes.
        own = sorted(of_task, key=lambda each: each.unit)
        kept = keep_rule(plan.keep).choose([each if each.key else None for each in own])
        roles: dict[Path, dict[RecordingKey, list[str]]] = {}
        for result, role in kept:
            if result.key is not None:
                folder = chunk_of[task, result.monitor].folder
                of_chunk = roles.setdefault(folder, {})
                of_chunk.setdefault(result.key, []).append(role)
        drawable: set[RecordingKey] = set()
        for each in chunks:
            folder, chosen = each.folder, roles.get(each.folder, {})
            if each.task.name != task or not (chosen or each.known.is_drawn_live):
                continue
            try:
                keys = write_choice(folder, chosen, rule=plan.keep, finished=len(own))
            except Error as error:
                logger.warning("%s: videos could not be chosen: %s", folder, error)
                keys = {*chosen}
                impossible |= {folder / key.video_name: str(error) for key in keys}
            videos += [(folder, key) for key in chosen if key in keys]
            drawable |= keys
        # The episodes keep the order in which the rule returned them.
        selection[task] = [
            ChosenEpisode(*result.unit, role)
            for result, role in kept
            if result.key in drawable
        ]
    return Choice(selection, videos, impossible)


def files_of(
    evaluation: Evaluation, chunks: Iterable[ChunkRun]
) -> Callable[[EpisodeResult], EpisodeFiles]:
    """Return a function that looks up an episode's files."""
    chunk_of = _by_monitor(chunks)
    chosen = {
        (task, each.seed, each.episode)
        for task, of_task in evaluation.selection.items()
        for each in of_task
    }

    @functools.lru_cache(maxsize=1)
    def names_in(folder: str) -> set[str]:
        place = evaluation.directory / folder
        files = (*iter_monitor_files(place), *finished_trajectories(place))
        return {path.name for path in files}

    def files_of_episode(result: EpisodeResult) -> EpisodeFiles:
        key = result.key
        if key is None:
            return EpisodeFiles()
        folder = chunk_of[result.task, result.monitor].place
        names, trajectory = names_in(folder), f"{key.name}{FINISHED}"
        # Text environments have a text recording instead of a video.
        as_text, video = f"{key.video_name.removesuffix('.mp4')}.json", None
        if as_text in names:
            video = as_text
        elif (result.task, *result.unit) in chosen:
            video = key.video_name
        return EpisodeFiles(folder, trajectory if trajectory in names else None, video)

    return files_of_episode


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


def _by_monitor(
    chunks: Iterable[ChunkRun],
) -> dict[tuple[str, str | None], ChunkRun]:
    """Return the chunks, keyed by task and monitor."""
    return {
        (each.task.name, result.monitor): each
        for each in chunks
        for result in each.known.results.values()
    }


def _submit(run: Run, each: ChunkRun) -> str:
    # A chunk is resubmitted only if its size has grown, so the key is unique.
    each.size = each.known.size
    key, chunk = f"{each.place}/{each.size}", dataclasses.asdict(each.chunk)
    run.submit(key, kind="run", task=each.task.name, folder=each.place, chunk=chunk)
    return key


def _progress(chunks: Iterable[ChunkRun]) -> EvaluationProgress:
    chunks = list(chunks)
    results = [result for each in chunks for result in each.known.results.values()]
    return EvaluationProgress(
        done=len(results),
        failed=sum(result.failure is not None for result in results),
        total=sum(len(each.chunk) for each in chunks),
    )

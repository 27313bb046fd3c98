# SPDX-License-Identifier: Apache-2.0
"""Handing out an evaluation, and following it until every episode is over.

What was done is read from the journals of the chunks, never from what workers return.
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
from ..formats.monitor_directory import Infix
from ..messages import unpacked
from ..recorder.keep_rules import keep_rule
from ..rendering.chosen_videos import write_choice
from ..rendering.engine_jobs import do_on_engine
from ..rendering.finish import bring_up_to_date
from ..rendering.finisher import do_jobs
from ..rendering.jobs import Progress, RecordingKey, VideoJob
from ..simulation.model_trust import note_models
from .chunk_results import ChunkResults, read_chunk
from .episode_results import EpisodeResult
from .evaluation import ChosenEpisode
from .plan import Chunk, EvaluatedTask, EvaluationPlan

logger = logging.getLogger(__name__)

# How often progress is reported, and the most of the time that counting it takes.
_SECONDS_BETWEEN_REPORTS = 0.25
_MOST_OF_TIME = 0.05


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


_Tell = Callable[[EvaluationProgress], object]


@dataclass
class ChunkRun:
    """A chunk of a task while it is run.

    Attributes:
        task: whose.
        chunk: which one.
        folder: its monitor directory.
        known: what is done of it.
        rounds: how often it was handed out.
        size: how much was done of it when it was handed out last.
        reason: why episodes of it have no result.
        is_over: nothing more comes.
    """

    task: EvaluatedTask
    chunk: Chunk
    folder: Path
    known: ChunkResults
    rounds: int = 0
    size: int = 0
    reason: str = "nothing is known of it"
    is_over: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether all of its episodes have ended."""
        return all(unit in self.known.results for unit in self.chunk)


@dataclass(frozen=True)
class Choice:
    """The episodes that get a video.

    Attributes:
        selection: those of each task.
        videos: the recordings, each once, by their chunks' monitor directories.
        impossible: why videos cannot be drawn, by their paths.
    """

    selection: Mapping[str, Sequence[ChosenEpisode]]
    videos: Sequence[tuple[Path, RecordingKey]]
    impossible: Mapping[Path, str]


def check_tasks(
    run: Run, plan: EvaluationPlan, *, workers: int = 1
) -> tuple[EvaluationPlan, Mapping[str, int]]:
    """Let workers make the environment and the policy of each new task, and no step.

    Args:
        run: the workers.
        plan: what is evaluated.
        workers: how many begin, where there are new tasks: all will make one of them
            anyway, and so they do it at once.

    Returns:
        The plan with their step limits; and how much work a step is, roughly.

    Raises:
        Error: the one that making them raised, such as an `UnknownName`.
    """
    unknown = {task.name: task for task in plan.tasks if task.step_limit is None}
    if unknown:
        for number in range(max(len(unknown), workers)):
            name = [*unknown][number % len(unknown)]
            run.submit(f"{number}", kind="check", task=name)
    velocities: dict[str, int] = {}
    for outcome in run.results():
        # Without timeout there is always one.
        assert outcome is not None
        said = outcome.value or {}
        name = [*unknown][int(outcome.key) % len(unknown)]
        if outcome.failure is not None:
            # No error of ours, which would have been carried: its worker died.
            raise EnvironmentNotMade(name, outcome.failure)
        if "error" in said:
            raise unpacked(said["error"])
        limit = said["step_limit"]
        unknown[name] = dataclasses.replace(unknown[name], step_limit=limit)
        velocities[name] = said["velocities"]
    tasks = tuple(unknown.get(task.name, task) for task in plan.tasks)
    return dataclasses.replace(plan, tasks=tasks), velocities


def chunks_in(directory: Path, plan: EvaluationPlan) -> list[ChunkRun]:
    """Return the chunks of an evaluation, with what is done of them."""
    return [
        ChunkRun(task, chunk, folder, read_chunk(folder, task.name))
        for task in plan.tasks
        for chunk in plan.chunks
        if (folder := directory / task.folder / chunk.folder)
    ]


def run_chunks(run: Run, chunks: Sequence[ChunkRun], tell: _Tell) -> EvaluationProgress:
    """Have the missing episodes of chunks run, and return how far they are.

    Args:
        run: the workers.
        chunks: in the order in which they are handed out.
        tell: called with how far they are.

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
            # This user's, though it was done elsewhere: by workers of this process.
            note_models((outcome.value or {}).get("models", ()))
            if not each.is_complete and each.known.size > each.size:
                # It came nearer to its end, and a poisoned episode fails alone.
                by_key[_submit(run, each)] = each
                continue
            each.is_over = True
            if not each.is_complete:
                said = outcome.failure or (
                    f"A worker has done {each.folder}, and what it recorded is not "
                    "there: all machines must see the directory under the same name."
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
    """Return the results of all episodes, in the order of the plan."""
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
    """Choose which episodes get a video, and write it down where they were recorded."""
    selection: dict[str, list[ChosenEpisode]] = {}
    videos: list[tuple[Path, RecordingKey]] = []
    impossible: dict[Path, str] = {}
    by_task: dict[str, list[EpisodeResult]] = {task.name: [] for task in plan.tasks}
    for result in results:
        by_task[result.task].append(result)
    for task, own in by_task.items():
        chosen: dict[str, dict[RecordingKey, list[ChosenEpisode]]] = {}
        # So that nothing but what was recorded decides among equals.
        own.sort(key=lambda each: each.unit)
        begun = [each if each.episode_id is not None else None for each in own]
        kept = keep_rule(plan.keep).choose(begun)
        for result, role in kept:
            chunk = plan.chunk_of(result.unit)
            infix = Infix.parse(result.monitor or "")
            if chunk and infix and result.episode_id is not None:
                key = RecordingKey(infix, result.episode_id)
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
                logger.warning("%s: no videos are chosen: %s", each.folder, error)
                keys = {*mine}
                impossible |= {each.folder / k.video_name: str(error) for k in keys}
            videos += [(each.folder, key) for key in mine if key in keys]
            drawable |= {e for key in mine if key in keys for e in mine[key]}
        # In the order of the rule.
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
        choice: which.
        directory: of the evaluation.
        engine: whose workers draw; None is processes of this one.
        workers: how many of these.
        progress: of the episodes.
        tell: called with how far it is.

    Returns:
        The videos that are there, and why others are not, by their paths.
    """
    jobs = [VideoJob.finishing(folder, key) for folder, key in choice.videos]
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

    if engine is None:
        done = do_jobs(jobs, directory, workers=workers, on_progress=show)
    else:
        done = do_on_engine(engine, jobs, on_progress=show)
    for result in done:
        elsewhere = dict.fromkeys(result.elsewhere, "Another process is drawing it.")
        for name, text in {**result.failures, **result.blank, **elsewhere}.items():
            why[result.directory / name] = text
    for folder in dict.fromkeys(folder for folder, _ in choice.videos):
        bring_up_to_date(folder)
    videos, pending = [], {}
    for folder, key in choice.videos:
        path = folder / key.video_name
        # Text is recorded as such.
        as_text = path.with_suffix(".json")
        path = as_text if as_text.exists() else path
        if path.exists():
            videos.append(path)
        else:
            text = why.get(path, "Its frames were not recorded.")
            pending[path] = f"{text} To try again: mjrec render {folder}"
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

# SPDX-License-Identifier: Apache-2.0
"""Handing out an evaluation, and following it until every episode is over.

Tasks are checked first: who names one that cannot be made shall know before anything is
written. Then batches of episodes are handed out, and as soon as all episodes of a task
are over, those that get a video are chosen, and its recordings are settled, while other
tasks still run. Where the workers draw, too, its videos come next.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..engines.jobs import Job, JobOutcome, Run, results_of
from ..errors import EnvironmentNotMade, PicturesDiffer
from ..formats.monitor_directory import Infix
from ..messages import unpacked
from ..rendering.engine_jobs import result_of
from ..rendering.jobs import RecordingKey, RenderedVideos, VideoJob
from ..rendering.recordings import may_be_left
from ..simulation.model_trust import note_models
from .episode_results import EpisodeResult
from .evaluation import EvaluationProgress
from .kept_episodes import Chosen, KeepRule, keep_rule
from .ledger import read_ledgers
from .plan import Batch, EvaluatedTask, EvaluationPlan
from .progress_counts import LedgerCounts
from .splitting import batches_of

logger = logging.getLogger(__name__)

# How often somebody who waits is told how far it is.
_PATIENCE_S = 0.25

# Of an engine that does not say how many it has.
_USUAL_WORKERS = 8

_Tell = Callable[[EvaluationProgress], object]
_Done = Mapping[str, Mapping[tuple[int, int], EpisodeResult]]


@dataclass
class TaskRun:
    """A task while it is evaluated, and then what came of it.

    Attributes:
        task: which one.
        unfinished: how many of its batches are not over.
        reasons: why episodes are not in any ledger, by seed and number.
        models: the hashes of compiled models that workers stored of episodes, likewise.
        results: of all its episodes, in the order of the plan, when they are over.
        chosen: of those, which get a video, each with its role.
        unsettled: how many of its recordings are being settled.
        problem: why its recordings could not be settled; None where they were.
        videos: how many videos of it workers draw.
        videos_done: how many of these are over.
        not_drawn: why workers could not draw videos, by their names.
    """

    task: EvaluatedTask
    unfinished: int = 0
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)
    models: dict[tuple[int, int], Sequence[str]] = field(default_factory=dict)
    results: list[EpisodeResult] = field(default_factory=list)
    chosen: list[Chosen] = field(default_factory=list)
    unsettled: int = 0
    problem: str | None = None
    videos: int = 0
    videos_done: int = 0
    not_drawn: dict[str, str] = field(default_factory=dict)

    @property
    def chosen_keys(self) -> list[RecordingKey]:
        """The chosen episodes as their recording knows them, each once."""
        return list(self.chosen_models)

    @property
    def chosen_models(self) -> dict[RecordingKey, Sequence[str]]:
        """The models of the chosen episodes, as far as workers have reported them."""
        keys: dict[RecordingKey, Sequence[str]] = {}
        for result, _ in self.chosen:
            infix = Infix.parse(result.monitor or "")
            if infix is not None and result.episode_id is not None:
                key = RecordingKey(infix, result.episode_id)
                keys[key] = self.models.get(result.unit, ())
        return keys


@dataclass(frozen=True, kw_only=True)
class CheckedTask:
    """What workers say of a task before it is run.

    Attributes:
        velocities: of its simulation: how much work a step is, roughly.
        is_drawn_live: pictures are wanted, and cannot be drawn later.
    """

    velocities: int
    is_drawn_live: bool


def check_tasks(
    run: Run, plan: EvaluationPlan, tasks: Iterable[EvaluatedTask]
) -> dict[str, CheckedTask]:
    """Let workers make the environment and the policy of each task, and no step.

    Returns:
        What they say of each, by name.

    Raises:
        Error: the one that making them raised, such as an `UnknownName`.
        PicturesDiffer: the rule chooses by returns, and the pictures of a task can only
            be drawn while it runs.
    """
    names = {f"check/{task.folder}": task.name for task in tasks}
    for key, name in names.items():
        run.submit(Job(key=key, arguments={"kind": "check", "task": name}))
    rule = keep_rule(plan.keep)
    checked: dict[str, CheckedTask] = {}
    for outcome in run.results():
        # Without patience there is always one.
        assert outcome is not None
        name = names[outcome.key]
        said = _checked(name, outcome, rule)
        checked[name] = CheckedTask(
            velocities=said["velocities"], is_drawn_live=not said["deferrable"]
        )
    return checked


def run_tasks(
    run: Run,
    home: Run,
    plan: EvaluationPlan,
    directory: Path,
    *,
    done: _Done,
    checked: Mapping[str, CheckedTask],
    draws: bool,
    on_results: Callable[[Sequence[TaskRun]], object],
    tell: _Tell,
) -> list[TaskRun]:
    """Run all that is not done, and return what came of each task.

    Args:
        run: runs the episodes and draws.
        home: does on this machine what is quick; may be the same.
        plan: what is evaluated.
        directory: of the evaluation.
        done: the results of what was done before, by task.
        checked: the tasks that are not done, as `check_tasks` says.
        draws: whether the workers draw the videos of the chosen episodes, too.
        on_results: called once, with the tasks, when all are settled: what is left
            then are videos.
        tell: is told how far it is.

    Raises:
        Error: workers cannot be started, or a ledger is damaged.
    """
    runner = _Runner(
        run, home, plan, directory, draws=draws, on_results=on_results, tell=tell
    )
    return runner.run(done, checked)


def _checked(task: str, outcome: JobOutcome, rule: KeepRule) -> Mapping[str, Any]:
    if outcome.failure is not None:
        # No error of ours, which would have been told: its worker died, or worse.
        raise EnvironmentNotMade(task, outcome.failure)
    said = outcome.value or {}
    if "error" in said:
        raise unpacked(said["error"])
    if rule.needs_returns and said.get("deferrable") is False:
        raise PicturesDiffer(
            f"keep={rule.name!r} chooses the videos of {task} by what has come of its "
            "episodes, and its pictures can only be drawn while it runs: "
            f"{said.get('reason')} Use keep='cubic', 'all' or 'none' (--keep cubic), "
            "which are known beforehand."
        )
    return said


class _Runner:
    """Runs one evaluation.

    Args:
        run: see `run_tasks`; so with all of these.
        home: likewise.
        plan: likewise.
        directory: likewise.
        draws: likewise.
        on_results: likewise.
        tell: likewise.
    """

    def __init__(
        self,
        run: Run,
        home: Run,
        plan: EvaluationPlan,
        directory: Path,
        *,
        draws: bool,
        on_results: Callable[[Sequence[TaskRun]], object],
        tell: _Tell,
    ) -> None:
        self._run = run
        self._home = home
        self._plan = plan
        self._directory = directory
        self._draws = draws
        self._on_results = on_results
        self._tell = tell
        self._rule = keep_rule(plan.keep)
        self._tasks = {task.folder: TaskRun(task) for task in plan.tasks}
        self._settled: list[TaskRun] = []
        self._batches: dict[str, Batch] = {}
        self._recordings: dict[str, RecordingKey] = {}
        self._counts = LedgerCounts(directory / task.folder for task in plan.tasks)

    def run(self, done: _Done, checked: Mapping[str, CheckedTask]) -> list[TaskRun]:
        batches = batches_of(
            self._plan,
            done,
            workers=self._run.workers or _USUAL_WORKERS,
            alone={name for name, of in checked.items() if of.is_drawn_live},
        )
        # What takes long comes first, so that all workers end at about the same time.
        for batch in sorted(batches, key=lambda each: -checked[each.task].velocities):
            self._submit_batch(batch)
        for of in self._tasks.values():
            if not of.unfinished:
                self._complete(of)
        for outcome in results_of(self._run, self._home, patience_s=_PATIENCE_S):
            if outcome is not None:
                self._take(outcome)
            self._tell(self._progress())
        return list(self._tasks.values())

    def _submit_batch(self, batch: Batch) -> None:
        key = f"run/{batch.folder}/{batch.seed}/{batch.episodes[0]}"
        self._batches[key] = batch
        self._tasks[batch.folder].unfinished += 1
        self._submit(key, asdict(batch))

    def _submit(self, key: str, arguments: Mapping[str, Any]) -> None:
        kind = key.partition("/")[0]
        run = self._run if kind in ("run", "draw") else self._home
        run.submit(Job(key=key, arguments={"kind": kind, **arguments}))

    def _take(self, outcome: JobOutcome) -> None:
        kind, folder, *_ = outcome.key.split("/")
        of = self._tasks[folder]
        match kind:
            case "run":
                self._take_batch(of, outcome)
            case "recover":
                self._take_recovered(of, outcome)
            case "settle":
                self._take_settled(of, outcome)
            case "draw":
                self._take_drawn(of, outcome)

    def _take_batch(self, of: TaskRun, outcome: JobOutcome) -> None:
        batch = self._batches[outcome.key]
        units = [(batch.seed, number) for number in batch.episodes]
        # This user's, though it was done elsewhere: by workers of this process.
        models = (outcome.value or {}).get("models", ())
        note_models(models)
        of.models.update(dict.fromkeys(units, models))
        if outcome.failure is not None:
            of.reasons.update(dict.fromkeys(units, _in_short(outcome.failure)))
        of.unfinished -= 1
        if not of.unfinished:
            self._complete(of)

    def _complete(self, of: TaskRun) -> None:
        """Choose among the episodes of a task, which are all over, and settle it."""
        folder = self._directory / of.task.folder
        done = read_ledgers(folder)
        of.results = [
            done.get((seed, number)) or _lost(of, seed, number)
            for seed in self._plan.seeds
            for number in range(self._plan.episodes)
        ]
        of.chosen = self._rule.choose(of.results)
        if folder.is_dir():
            name = of.task.folder
            self._submit(f"recover/{name}", {"folder": name})
        else:
            self._note_settled(of)

    def _take_recovered(self, of: TaskRun, outcome: JobOutcome) -> None:
        _note_problem(of, outcome)
        facts = _facts_by_monitor(of)
        monitors = (outcome.value or {}).get("monitors", ())
        of.unsettled = len(monitors)
        if not monitors:
            self._note_settled(of)
        for monitor in monitors:
            name = of.task.folder
            chosen = facts.get(monitor, [])
            self._submit(
                f"settle/{name}/{monitor}",
                {"folder": name, "monitor": monitor, "chosen": chosen},
            )

    def _take_settled(self, of: TaskRun, outcome: JobOutcome) -> None:
        _note_problem(of, outcome)
        of.unsettled -= 1
        if not of.unsettled:
            self._note_settled(of)

    def _note_settled(self, of: TaskRun) -> None:
        self._settled.append(of)
        if self._draws:
            self._submit_videos(of)
        if len(self._settled) == len(self._tasks):
            self._on_results(list(self._tasks.values()))

    def _submit_videos(self, of: TaskRun) -> None:
        folder = of.task.folder
        chosen = of.chosen_models
        of.videos = len(chosen)
        for key, models in chosen.items():
            if not may_be_left(self._directory / folder, key):
                of.videos_done += 1
                continue
            job = f"draw/{folder}/{key.told_name}"
            self._recordings[job] = key
            self._submit(
                job,
                {"folder": folder, "recording": key.told_name, "models": models},
            )

    def _take_drawn(self, of: TaskRun, outcome: JobOutcome) -> None:
        key = self._recordings[outcome.key]
        folder = self._directory / of.task.folder
        of.videos_done += 1
        of.not_drawn |= not_drawn(result_of(outcome, VideoJob.finishing(folder, key)))

    def _progress(self) -> EvaluationProgress:
        plan = self._plan
        total = len(plan.tasks) * len(plan.seeds) * plan.episodes
        done, failed = 0, 0
        with contextlib.suppress(OSError):
            done, failed = self._counts.look()
        # An episode that was run twice is still one.
        return EvaluationProgress(
            done=min(done, total),
            failed=min(failed, total),
            total=total,
            videos_done=sum(of.videos_done for of in self._settled),
            videos=sum(of.videos for of in self._settled),
        )


def not_drawn(result: RenderedVideos) -> dict[str, str]:
    """Return why videos are not there, or show nothing, by their names."""
    elsewhere = dict.fromkeys(result.elsewhere, "Another process is drawing it.")
    return {**result.failures, **result.blank, **elsewhere}


def _in_short(failure: str) -> str:
    """Return why a job failed, without what its worker printed, which is logged."""
    logger.warning("%s", failure)
    return failure.partition(" The end of what it said")[0]


def _note_problem(of: TaskRun, outcome: JobOutcome) -> None:
    if outcome.failure is not None:
        of.problem = outcome.failure
        logger.warning(
            "The recordings of %s could not be settled, and stay as they are: %s The "
            "same evaluation with resume=True (--resume) tries again.",
            of.task.name,
            outcome.failure,
        )


def _lost(of: TaskRun, seed: int, number: int) -> EpisodeResult:
    """Return the result of an episode that was begun, and that nothing came of."""
    return EpisodeResult(
        task=of.task.name,
        seed=seed,
        episode=number,
        total_reward=None,
        length=0,
        terminated=None,
        truncated=None,
        failure=of.reasons.get((seed, number), "nothing is known of it"),
    )


def _facts_by_monitor(of: TaskRun) -> dict[str, list[list[Any]]]:
    """Return the numbers of chosen episodes, each with what is said of the choice."""
    roles: dict[tuple[str, int], list[str]] = {}
    for result, role in of.chosen:
        if result.monitor is not None and result.episode_id is not None:
            roles.setdefault((result.monitor, result.episode_id), []).append(role)
    facts: dict[str, list[list[Any]]] = {}
    for (monitor, number), of_episode in roles.items():
        said = {"finished": len(of.results), "roles": of_episode}
        facts.setdefault(monitor, []).append([number, said])
    return facts
